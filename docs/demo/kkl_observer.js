// A learned KKL observer in plain JavaScript, for browsers and Node: no dependencies.
//
//   const observer = new Observer(await (await fetch("lorenz_step.safetensors")).arrayBuffer());
//   let xHat = observer.reset([y0]);     // the first sample
//   xHat = observer.step([y], [u]);      // every dt seconds: the sample, and the input that was held before it
//
// `python docs/demo/step_file.py MAP lorenz_step.safetensors` writes the file. The filter and the whitening are of doubles, the weights of floats.

/** The arrays of a safetensors file by name, and its metadata. */
export function readTensors(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const { __metadata__: metadata, ...entries } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const types = { F32: Float32Array, F64: Float64Array };
  const tensors = Object.entries(entries).map(([name, { dtype, shape, data_offsets: ends }]) =>
    [name, { data: new types[dtype](buffer.slice(...ends.map((end) => 8 + length + end))), shape }]);
  return { tensors: Object.fromEntries(tensors), metadata };
}

const ACTIVATIONS = {
  tanh: Math.tanh,
  silu: (value) => 0.5 * value + 0.5 * value * Math.tanh(0.5 * value), // cannot overflow
  relu: (value) => Math.max(value, 0),
};

function dot(a, b) {
  let sum = 0;
  for (let i = 0; i < a.length; i++) sum += a[i] * b[i];
  return sum;
}

/** Rows of numbers that lie one after another. */
const matrix = ({ data, shape: [rows, width] }) =>
  Array.from({ length: rows }, (_, i) => Array.from(data.subarray(i * width, (i + 1) * width)));

/** A network as a function of its inputs. */
function network(tensors, prefix, activation) {
  const layers = [], active = ACTIVATIONS[activation];
  for (let i = 0; tensors[`${prefix}${i}.weight`]; i++) {
    layers.push([matrix(tensors[`${prefix}${i}.weight`]), tensors[`${prefix}${i}.bias`].data]);
  }
  const layer = (h, [rows, biases]) => rows.map((row, i) => dot(row, h) + biases[i]);
  return (inputs) => layers.reduce((h, each, depth) => layer(depth ? h.map((value) => active(value)) : h, each), inputs);
}

/** Of rows of numbers at points that rise from 0, that between them at x; beyond the last point, its row. */
function between(x, points, rows, size = 1) {
  let i = 0;
  while (i + 2 < points.length && x >= points[i + 1]) i++;
  const share = points.length > 1 ? Math.min((x - points[i]) / (points[i + 1] - points[i]), 1) : 0;
  return Float64Array.from({ length: size }, (_, k) => {
    const low = rows[i * size + k];
    return share ? low + share * (rows[(i + 1) * size + k] - low) : low;
  });
}

const OPERATIONS = {
  "+": (a, b) => a + b, "*": (a, b) => a * b, "**": Math.pow, "%": (a, b) => (a % b) + ((a % b) * b < 0 ? b : 0),
  minimum: Math.min, maximum: Math.max, "<": (a, b) => a < b, "<=": (a, b) => a <= b, ">": (a, b) => a > b, ">=": (a, b) => a >= b,
  and: (a, b) => a && b, or: (a, b) => a || b, not: (a) => !a,
};

/** An expression, as observers.Expression has it, as a function of state and input. */
function evaluated(part) {
  if (typeof part === "number") return () => part;
  const [name, ...rest] = part;
  if (name === "x" || name === "u") return name === "x" ? (x) => x[rest[0]] : (x, u) => u[rest[0]];
  const of = rest.map(evaluated), operation = OPERATIONS[name] ?? Math[name];
  if (name === "where") return (x, u) => (of[0](x, u) ? of[1](x, u) : of[2](x, u));
  if (of.length === 1) return (x, u) => operation(of[0](x, u));
  return of.reduce((a, b) => (x, u) => operation(a(x, u), b(x, u)));
}

/** T_inv: the filter's state, the age and the levels of noise to an estimate. */
class InverseMap {
  constructor(tensors, prefix, described) {
    Object.assign(this, described);
    for (const name of ["z_offset", "x_offset", "x_scale"]) this[name] = tensors[prefix + name].data;
    for (const name of ["whiten", "noise_gain"]) this[name] = matrix(tensors[prefix + name]);
    for (const name of ["levels", "ages", "covariance"]) this[name] = tensors[prefix + name]?.data;
    this.network = network(tensors, prefix, this.activation);
  }

  /** The assumed noise; measured is a level for each output, cut at the largest in training. */
  tell(measured, process) {
    this.gain = this.whiten.map((_, i) => 1 / (1 + this.noise_gain.reduce((sum, gains, k) => sum + (measured[k] * gains[i]) ** 2, 0)));
    this.conditions = [];
    if (this.features.includes("measurement_noise")) this.conditions = this.measurement_noise_unit.map((unit, k) => Math.log1p(measured[k] / unit));
    if (this.features.includes("process_noise")) this.conditions.push(Math.log1p(Math.min(process, this.process_noise_max) / this.process_noise_unit));
    const share = Math.max(...measured.map((level, k) => level / (this.measurement_noise_max?.[k] ?? Infinity)));
    this.shares = [share, process / (this.process_noise_max ?? Infinity)]; // of the largest levels in training
    if (this.levels) this.byAge = between(share, this.levels, this.covariance, this.covariance.length / this.levels.length);
  }

  mean(z, age) {
    const off = this.z_offset.map((value, j) => z[j] - value);
    const inputs = [...this.whiten.map((row, i) => this.gain[i] * dot(row, off)), ...this.conditions];
    if (this.features.includes("age")) inputs.push(Math.log1p(Math.min(age, this.age_max ?? Infinity) / this.age_unit));
    return this.network(inputs).map((value, i) => this.x_offset[i] + this.x_scale[i] * value);
  }

  /** The covariance of the estimate's error at an age in seconds; null without a covariance. */
  at(age) {
    if (!this.levels) return null;
    const nx = Math.sqrt(this.byAge.length / this.ages.length);
    return matrix({ data: between(age, this.ages, this.byAge, nx * nx), shape: [nx, nx] });
  }
}

const transposed = (A) => A[0].map((_, j) => A.map((row) => row[j]));
/** P + sign V W^T, for V and W by columns. */
const added = (P, V, W, sign = 1) => P.map((row, i) => row.map((value, j) => V.reduce((sum, column, k) => sum + sign * column[i] * W[k][j], value)));
/** x + sign V w. */
const shifted = (x, V, w, sign = 1) => x.map((value, i) => V.reduce((sum, column, k) => sum + sign * column[i] * w[k], value));
/** Values, and others where these are not finite. */
const defined = (values, others) => values.map((value, k) => (Number.isFinite(value) ? value : others[k]));
const finite = (...arrays) => arrays.flat(2).every(Number.isFinite);

/** L of P = L L^T; NaN where P is not positive definite. */
function factor(P) {
  const L = P.map((row) => row.map(() => 0));
  for (let i = 0; i < P.length; i++) {
    for (let j = 0; j <= i; j++) {
      const entry = P[i][j] - dot(L[i].slice(0, j), L[j]);
      L[i][j] = i > j ? entry / L[j][j] : entry > 0 ? Math.sqrt(entry) : NaN;
    }
  }
  return L;
}

/** Columns P^-1 b for columns b. */
function solved(P, columns) {
  const L = factor(P), upper = transposed(L);
  return columns.map((b) => {
    const x = [...b];
    for (let i = 0; i < x.length; i++) x[i] = (x[i] - dot(L[i].slice(0, i), x)) / L[i][i];
    for (let i = x.length - 1; i >= 0; i--) x[i] = (x[i] - dot(upper[i].slice(i + 1), x.slice(i + 1))) / L[i][i];
    return x;
  });
}

/** A Kalman filter on the motion of the system, as observers.tracker has it. */
class Tracker {
  constructor(tensors, described, output) {
    Object.assign(this, described, { output });
    for (const [name, each] of Object.entries(tensors).filter(([name]) => name.startsWith("motion."))) {
      this[name.slice(7)] = each.shape.length === 2 ? matrix(each) : [...each.data];
    }
    this.ny = this.least_measurement_noise.length;
    this.field = this.field?.map(evaluated);
    if (!this.field) this.network = network(tensors, "motion.", this.activation);
  }

  /** The assumed noise; measured is a level for each output, shares are levels in multiples of the largest. */
  tell(measured, process, [share, processShare]) {
    const level = Math.max(process, this.least_process_noise);
    this.Q = this.error.map((error, i) => (level * this.process_noise[i]) ** 2 + error ** 2);
    this.R = measured.map((own, k) => Math.max(own, this.least_measurement_noise[k]) ** 2);
    const table = between(processShare, [0, 1], this.factors, this.factors.length / 2);
    this.logFactors = between(share, this.levels, table, this.ages.length).map(Math.log);
  }

  /** Begin with the first sample; the map is of z. */
  begin(y, map, z) {
    [this.x, this.P, this.seen] = [this.start_mean, this.start_covariance, 0];
    this.#watchAnew();
    const { V, white } = this.#corrected(this.x, this.P, y), P = added(this.P, V, V, -1);
    if (finite(white, factor(P))) [this.x, this.P] = [this.#within(shifted(this.x, V, white)), P];
    this.supervise(map, z, 0);
  }

  /** The covariance of the estimate's error, at an age in samples. */
  calibrated(age) {
    const factor = Math.exp(between(age * this.dt, this.ages, this.logFactors)[0]), { x_scale: scale } = this;
    return this.P.map((row, i) => row.map((value, j) => factor * scale[i] * scale[j] * value));
  }

  /** Scaled states in their units. */
  state(s = this.x) {
    return s.map((value, i) => this.x_offset[i] + this.x_scale[i] * value);
  }

  #within(s) {
    return s.map((value, i) => Math.min(Math.max(value, this.low[i]), this.high[i]));
  }

  #watchAnew() {
    [this.nis, this.trendSquare, this.trend] = [1, 1, new Array(this.ny).fill(0)];
  }

  /** Scaled states a sample later. */
  #moved(at, u) {
    const s = this.#within(at);
    if (this.network) {
      const q = [...s, ...this.u_scale.map((scale, j) => u[j] / scale)], h = this.network(q);
      return this.#within(s.map((value, i) => value + dot(this.linear[i], [1, ...q]) + this.gain[i] * h[i]));
    }
    const f = (x) => this.field.map((part) => part(x, u));
    let x = this.substeps ? this.state(s) : f(this.state(s));
    for (let n = 0, h = this.dt / this.substeps; n < this.substeps; n++) {
      const ahead = (step, k) => f(x.map((value, i) => value + step * k[i]));
      const a = f(x), b = ahead(h / 2, a), c = ahead(h / 2, b), d = ahead(h, c);
      x = x.map((value, i) => value + (h / 6) * (a[i] + 2 * (b[i] + c[i]) + d[i]));
    }
    return this.#within(x.map((value, i) => (value - this.x_offset[i]) / this.x_scale[i]));
  }

  /** What a function and noise make of a Gaussian, by sigma points: mean, covariance, and that with the states by columns. */
  #transformed(x, P, noise, of) {
    const { middle, middle_squares: squares, other } = this, far = Math.sqrt(0.5 / other);
    const columns = transposed(factor(P)).map((column) => column.map((value) => far * value));
    const first = of(x), ends = columns.flatMap((column) => [1, -1].map((sign) => of(shifted(x, [column], [sign]), first)));
    const mean = first.map((value, i) => middle * value + other * ends.reduce((sum, end) => sum + end[i], 0));
    const [centre, ...off] = [first, ...ends].map((to) => to.map((value, i) => value - mean[i]));
    const product = (i, j) => squares * centre[i] * centre[j] + other * off.reduce((sum, to) => sum + to[i] * to[j], 0);
    const S = mean.map((_, i) => mean.map((_, j) => product(i, j) + (i === j ? noise[i] : 0)));
    const across = mean.map((_, i) => shifted(x.map(() => 0), columns, columns.map((_, n) => other * (off[2 * n][i] - off[2 * n + 1][i]))));
    return [mean, S, across];
  }

  /** The update by a sample, NaN for missing entries: the state is then mean + V white with covariance P - V V^T. */
  #corrected(mean, P, y) {
    const [expected, S, V] = this.#transformed(mean, P, this.R, (s, first) => { // where h is undefined, it is that nearby
      const h = defined(...[s, this.#within(s)].map((at) => this.output(this.state(at))));
      return first ? defined(h, first) : h;
    });
    const white = y.map((value, k) => value - expected[k]);
    for (let k = 0; k < this.ny; k++) {
      const missing = Number.isNaN(y[k]), root = Math.sqrt(S[k][k]);
      white[k] = missing ? 0 : white[k] / root;
      V[k] = V[k].map((value) => (missing ? 0 : value / root));
      for (let l = k + 1; l < this.ny && !missing; l++) {
        const share = S[l][k] / root;
        white[l] -= share * white[k];
        V[l] = V[l].map((value, i) => value - share * V[k][i]);
        for (let m = k + 1; m <= l; m++) S[l][m] -= (share * S[m][k]) / root;
      }
    }
    return { V, white, expected };
  }

  /** Predict again, with the motion linearised about where the step began as far as the sample tells. */
  #relinearised([mean, P, across], y, u) {
    const { V, white } = this.#corrected(mean, P, y);
    const G = solved(P, V).map((column) => transposed(across).map((row) => dot(row, column)));
    const start = shifted(this.x, G, white), spread = added(this.P, G, G, -1);
    const [again, S, ofStart] = this.#transformed(start, spread, this.Q, (s) => this.#moved(s, u));
    const D = solved(spread, G).map((column) => ofStart.map((row) => dot(row, column)));
    const next = [shifted(again, D, white, -1), added(S, D, D), added(ofStart, D, G)];
    return finite(next[0], factor(next[1])) ? next : [mean, P, across];
  }

  /** Take in a sample, of which outputs may be NaN, after an input; returns it, with the predicted outputs in their place. */
  advance(y, u, before) {
    let prediction = this.#transformed(this.x, this.P, this.Q, (s) => this.#moved(s, u));
    for (let turn = 0; turn < this.relinearisations && this.seen < this.window; turn++) prediction = this.#relinearised(prediction, y, u);
    const { V, white, expected } = this.#corrected(prediction[0], prediction[1], y);
    const whole = defined(y, defined(expected, before));
    const x = shifted(prediction[0], V, white), P = added(prediction[1], V, V, -1);
    const there = y.map((value) => Number(!Number.isNaN(value))), count = dot(there, there);
    if (finite(x, P)) [this.x, this.P] = [this.#within(x), P];
    else this.nis = Infinity; // lost
    if (!count || this.nis === Infinity) return whole;
    this.seen++;
    this.trend = this.trend.map((value, k) => value + this.trend_share * there[k] * (white[k] - value));
    const raised = this.trend_gain * dot(there, this.trend.map((value) => value ** 2));
    this.nis += ((this.share * count) / this.ny) * (dot(white, white) / count - this.nis);
    this.trendSquare += ((this.trend_square_share * count) / this.ny) * (raised / count - this.trendSquare);
    if (this.trendSquare > this.trend_limit) { // innovations agree with one another
      this.P = P.map((row) => row.map((value) => this.inflation * value));
      [this.trendSquare, this.trend] = [1, there.map(() => 0)];
    }
    return whole;
  }

  /** Take T_inv's estimate at an age in samples where it is surer, soon after a reset, or where the filter diverged. */
  supervise(map, z, age) {
    const lost = !(this.nis <= this.limit); // true for NaN as well
    if (!lost && this.seen >= this.window) return;
    const P = map.at(Math.min(this.seen, this.window) * this.dt); // what misled the filter may have misled z as well
    const logDeterminant = (matrix) => factor(matrix).reduce((sum, row, i) => sum + Math.log(row[i]), 0);
    if (!lost && !(logDeterminant(P) < logDeterminant(this.P))) return;
    this.x = this.#within(map.mean(z, age * this.dt).map((value, i) => (value - this.x_offset[i]) / this.x_scale[i]));
    this.P = P;
    if (lost) this.#watchAnew();
  }
}

/** Whether samples still fit the estimates: running mean and mean square of y - h(x_hat) over their limits. */
class Monitor {
  constructor(tensors, { window, warm_up: warmUp }, measured, dt) {
    const tables = ["levels", "mean", "low", "high"].map((name) => transposed(matrix(tensors[`limits.${name}`]))); // by output
    const part = measured.map((level, i) => level / (tables[0][i].at(-1) || Infinity)), highest = Math.max(...part);
    this.limits = measured.map((own, i) => {
      const [levels, mean, low, high] = tables.map((table) => table[i]);
      const noisiest = part[i] === highest ? own : highest * levels.at(-1);
      const at = (level, limits) => between(level ** 2, levels.map((each) => each ** 2), limits)[0]; // as variances add up
      return { mean: Math.sqrt(at(noisiest, mean.map((value) => value ** 2))), low: at(own, low), high: at(noisiest, high) };
    });
    [this.share, this.silent] = [-Math.expm1(-dt / window), Math.round(warmUp / dt)];
    this.sound = this.limits.map(({ low: least }, i) => Math.max(measured[i] ** 2, least));
    this.reset();
  }

  reset() {
    [this.mean, this.square, this.age] = [this.sound.map(() => 0), this.sound, 0];
  }

  update(residual, seen) {
    const average = (mean, value, i) => mean + (seen[i] ? this.share * (value - mean) : 0);
    this.mean = this.mean.map((mean, i) => average(mean, residual[i], i));
    this.square = this.square.map((square, i) => average(square, residual[i] ** 2, i));
    this.age += Number(seen.includes(true));
  }

  get score() {
    const worst = ({ mean, low, high }, i) => [Math.abs(this.mean[i]) / mean, this.square[i] / high, low / Math.max(this.square[i], 1e-300)];
    return this.age > this.silent ? Math.max(...this.limits.flatMap(worst)) : 0;
  }
}

/** Whether there are so many finite numbers, or else entries that are missing where these may be. */
const holds = (values, count, gaps = false) =>
  values?.length === count && Array.from(values).every((value) => Number.isFinite(value) || (gaps && Number.isNaN(value ?? NaN)));

/** The invalid value, for a message. */
const shown = (value) => {
  if (typeof value !== "object" || !value) return typeof value === "string" ? JSON.stringify(value) : String(value);
  return value.length === undefined ? "an object" : `[${Array.from(value, shown).join(", ")}]`;
};

export class Observer {
  /** Of an ArrayBuffer that `step_file.py` wrote. */
  constructor(buffer) {
    const { tensors, metadata } = readTensors(buffer);
    this.described = JSON.parse(metadata.kkl_step);
    this.tensors = tensors;
    this.filter = Object.fromEntries(["transition", "early_y", "late_y", "equilibrium"].map((name) => [name, matrix(tensors[name])]));
    [this.nz, this.ny] = tensors.early_y.shape;
    [this.nu, this.dt] = [this.described.u.length, this.described.dt];
    const { motion, maps } = this.described, h = this.described.h?.map(evaluated), C = tensors.C && matrix(tensors.C);
    this.output = C ? (x) => C.map((row) => dot(row, x)) : h && ((x) => h.map((part) => part(x)));
    for (const [label, map] of Object.entries(maps)) this[label] = new InverseMap(tensors, `${label}.`, map); // driven, free
    this.tracker = motion ? new Tracker(tensors, { ...motion, dt: this.dt }, this.output) : null;
    this.tell(this.described.measurement_noise ?? 0, this.described.process_noise ?? 0);
  }

  /** The levels of noise that are assumed: of all outputs or each, and of the state. The monitor restarts. */
  tell(measurementNoise = this.measurementNoise, processNoise = this.processNoise) {
    Object.assign(this, { measurementNoise, processNoise });
    const each = Array.from({ length: this.ny }, (_, i) => {
      const level = Array.isArray(measurementNoise) ? measurementNoise[i] ?? measurementNoise[0] : measurementNoise;
      return Math.min(level, this.driven.measurement_noise_max?.[i] ?? Infinity);
    });
    for (const map of [this.driven, this.free]) map?.tell(each, processNoise);
    this.tracker?.tell(each, processNoise, this.driven.shares);
    this.monitor = this.described.limits ? new Monitor(this.tensors, this.described.limits, each, this.dt) : null;
  }

  /** Forget the past and take in the first sample; returns the estimate. */
  reset(y0) {
    if (!holds(y0, this.ny)) throw new Error(`the first sample has ${this.ny} finite outputs, got ${shown(y0)}`);
    this.y = [...y0];
    this.z = new Float64Array(this.nz * (1 + this.nu));
    this.z.set(this.filter.equilibrium.map((row) => dot(row, this.y)));
    this.age = 0;
    this.monitor?.reset();
    this.tracker?.begin(this.y, this.#map(), this.z);
    return (this.xHat = this.#estimated());
  }

  /** Take in the next sample, NaN or null where an output or all are missing, and the input before it; returns the estimate. */
  step(y, u = new Array(this.nu).fill(0)) {
    if (!this.y) throw new Error("call reset(y0) before step");
    if (y !== null && !holds(y, this.ny, true)) throw new Error(`a sample has ${this.ny} outputs, NaN where one is missing, or is null, got ${shown(y)}`);
    if (!holds(u, this.nu)) throw new Error(`an input has ${this.nu} finite entries, got ${shown(u)}`);
    const missing = this.y.map((_, i) => Number.isNaN(y?.[i] ?? NaN));
    const there = missing.map((gap, i) => (gap ? NaN : y[i]));
    let now = there;
    if (this.tracker) now = this.tracker.advance(there, u, this.y);
    else if (missing.includes(true)) {
      if (!this.output) throw new Error("this map holds no output h(x) to predict with: pass the last sample again");
      const filled = (xHat) => defined(there, defined(this.output(xHat), this.y));
      now = filled(this.#estimated(this.#advanced(filled(this.#estimated()), u), this.age + 1));
    }
    this.z = this.#advanced(now, u);
    this.y = now;
    this.age++;
    this.tracker?.supervise(this.#map(), this.z, this.age);
    this.xHat = this.#estimated();
    if (this.monitor && y !== null) {
      const residual = this.output(this.xHat).map((value, i) => (Number.isFinite(value) ? this.y[i] - value : 0));
      this.monitor.update(residual, missing.map((gap) => !gap));
    }
    return this.xHat;
  }

  /** Above 1 the samples do not fit the estimates; null without limits to judge by. */
  get score() {
    return this.monitor?.score ?? null;
  }

  /** Covariance of the estimate's error, rows of numbers; null where the map holds no error bars. */
  get covariance() {
    return this.tracker ? this.tracker.calibrated(this.age) : this.#map().at(this.age * this.dt);
  }

  /** The map of free motion until an input has acted. */
  #map(z = this.z) {
    return this.free && !z.some((value, i) => i >= this.nz && value !== 0) ? this.free : this.driven;
  }

  #estimated(z = this.z, age = this.age) {
    return this.tracker ? this.tracker.state() : this.#map(z).mean(z, age * this.dt);
  }

  /** z one sample later. */
  #advanced(y, u) {
    const { nz, filter: { transition, early_y: early, late_y: late }, tensors: { held_u: held } } = this;
    return this.z.map((_, at) => {
      const block = Math.floor(at / nz), i = at % nz, before = dot(transition[i], this.z.subarray(block * nz, (block + 1) * nz));
      return before + (block ? held.data[i] * u[block - 1] : dot(early[i], this.y) + dot(late[i], y));
    });
  }
}
