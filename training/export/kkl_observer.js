// A learned KKL observer in plain JavaScript, for browsers and Node: no dependencies.
//
//   const observer = new Observer(await (await fetch("lorenz_step.safetensors")).arrayBuffer());
//   let xHat = observer.reset([y0]);     // the first sample
//   xHat = observer.step([y], [u]);      // every dt seconds: the sample, and the input that was held before it
//
// `kkl-gym export MAP --format js` writes the file. The filter and the whitening are of doubles, the weights of floats.

/** The arrays of a safetensors file by name, and its metadata. */
export function readTensors(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const { __metadata__: metadata, ...entries } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const types = { F32: Float32Array, F64: Float64Array };
  const tensors = {};
  for (const [name, { dtype, shape, data_offsets: [begin, end] }] of Object.entries(entries)) {
    tensors[name] = { data: new types[dtype](buffer.slice(8 + length + begin, 8 + length + end)), shape };
  }
  return { tensors, metadata };
}

const ACTIVATIONS = {
  tanh: (h) => h.forEach((value, i) => (h[i] = Math.tanh(value))),
  silu: (h) => h.forEach((value, i) => (h[i] = 0.5 * value + 0.5 * value * Math.tanh(0.5 * value))), // cannot overflow
  relu: (h) => h.forEach((value, i) => (h[i] = Math.max(value, 0))),
};

/** out = weights h + biases. */
function product(weights, biases, inputs, outputs, h, out) {
  for (let i = 0, w = 0; i < outputs; i++) {
    let a = biases[i], b = 0, c = 0, d = 0, j = 0; // several sums: none waits for the one before
    for (; j + 3 < inputs; j += 4, w += 4) {
      a += weights[w] * h[j];
      b += weights[w + 1] * h[j + 1];
      c += weights[w + 2] * h[j + 2];
      d += weights[w + 3] * h[j + 3];
    }
    for (; j < inputs; j++) a += weights[w++] * h[j];
    out[i] = a + b + (c + d);
  }
}

class Network {
  constructor(tensors, prefix, activation) {
    this.activate = ACTIVATIONS[activation];
    this.layers = [];
    for (let i = 0; tensors[`${prefix}${i}.weight`]; i++) {
      const weights = tensors[`${prefix}${i}.weight`];
      const [outputs, inputs] = weights.shape;
      const biases = tensors[`${prefix}${i}.bias`].data;
      this.layers.push({ weights: weights.data, biases, outputs, inputs, out: new Float64Array(outputs) });
    }
  }

  /** The outputs, in an array that the next call writes into. */
  run(given) {
    let h = given;
    for (let depth = 0; depth < this.layers.length; depth++) {
      const { weights, biases, outputs, inputs, out } = this.layers[depth];
      product(weights, biases, inputs, outputs, h, out);
      if (depth < this.layers.length - 1) this.activate(out);
      h = out;
    }
    return h;
  }
}

/** Linear between points, as numpy.interp. */
function interpolate(x, xs, values) {
  let i = 0;
  while (i < xs.length && xs[i] <= x) i++;
  if (i === 0) return values[0];
  if (i === xs.length) return values[i - 1];
  return values[i - 1] + ((x - xs[i - 1]) / (xs[i] - xs[i - 1])) * (values[i] - values[i - 1]);
}

/** Values of tables by level of noise and age, at each age: between levels, and between none and the most process noise. */
function byAge(table, { levels, ages }, share, processShare, of = (value) => value) {
  const count = levels.data.length, m = ages.data.length;
  const part = table.shape.length === 3 ? Math.min(processShare, 1) : 0;
  return Float64Array.from(ages.data, (_, j) => {
    const column = (k) => interpolate(share, levels.data, Array.from(levels.data, (_, i) => of(table.data[(k * count + i) * m + j])));
    return part ? (1 - part) * column(0) + part * column(1) : column(0);
  });
}

/** T_inv: the filter's state, the age and the levels of noise to an estimate. */
class InverseMap {
  constructor(tensors, prefix, described) {
    Object.assign(this, described);
    for (const name of ["z_offset", "whiten", "noise_gain", "x_offset", "x_scale"]) this[name] = tensors[prefix + name];
    [this.modes, this.size] = this.whiten.shape;
    this.network = new Network(tensors, prefix, this.activation);
    this.inputs = new Float64Array(this.network.layers[0].inputs);
    if (this.spread) {
      this.spreadNetwork = new Network(tensors, `${prefix}spread.`, this.spread.activation);
      for (const name of ["levels", "ages", "factors"]) this.spread[name] = tensors[`${prefix}spread.${name}`];
    }
  }

  /** What is assumed of noise; measured is a level for each output. */
  tell(measured, process) {
    const gains = this.noise_gain, rows = gains.shape.length === 2 ? gains.shape[0] : 1;
    this.gain = Float64Array.from({ length: this.modes }, (_, i) => {
      let variance = 0;
      for (let row = 0; row < rows; row++) variance += (measured[row] * gains.data[row * this.modes + i]) ** 2;
      return 1 / (1 + variance);
    });
    const of = (values, i) => (Array.isArray(values) ? values[i] : values);
    let at = this.modes;
    if (this.features.includes("measurement_noise")) {
      const told = Array.isArray(this.measurement_noise_unit) ? measured : measured.slice(0, 1);
      told.forEach((level, i) => (this.inputs[at++] = Math.log1p(level / of(this.measurement_noise_unit, i))));
    }
    if (this.features.includes("process_noise")) {
      this.inputs[at++] = Math.log1p(Math.min(process, this.process_noise_max) / this.process_noise_unit);
    }
    this.ageInput = at;
    if (this.spread) {
      this.logFactors = byAge(this.spread.factors, this.spread, ...this.shares(measured, process), (factor) => Math.log(factor) / 2);
    }
  }

  /** Levels in multiples of the highest that the map is told, of the noisiest output. */
  shares(measured, process) {
    const ends = this.measurement_noise_max;
    const share = ends == null ? 0 : Math.max(...measured.map((level, i) => level / (Array.isArray(ends) ? ends[i] : ends)));
    return [share, this.process_noise_max ? process / this.process_noise_max : 0];
  }

  read(z, age) {
    const { whiten: { data }, z_offset: { data: offset }, size, inputs } = this;
    for (let i = 0, w = 0; i < this.modes; i++) {
      let mode = 0;
      for (let j = 0; j < size; j++) mode += data[w++] * (z[j] - offset[j]);
      inputs[i] = this.gain[i] * mode;
    }
    if (this.features.includes("age")) inputs[this.ageInput] = Math.log1p(Math.min(age, this.age_max ?? Infinity) / this.age_unit);
    return inputs;
  }

  mean(z, age) {
    const h = this.network.run(this.read(z, age));
    return Array.from(h, (value, i) => this.x_offset.data[i] + this.x_scale.data[i] * value);
  }

  covariance(z, age) {
    const out = this.spreadNetwork.run(this.read(z, age));
    const nx = (Math.sqrt(8 * out.length + 1) - 1) / 2;
    const factor = interpolate(age, this.spread.ages.data, this.logFactors);
    const rows = [];
    for (let i = 0, k = nx; i < nx; i++) {
      const scale = Math.exp(Math.min(out[i], 100) + factor);
      const row = [...Array.from({ length: i }, () => scale * out[k++]), scale];
      const variance = row.reduce((sum, value) => sum + value * value, 0), largest = (4 * this.x_scale.data[i]) ** 2; // as observers.spread has it
      rows.push(variance > largest ? row.map((value) => value * Math.sqrt(largest / variance)) : row);
    }
    const entry = (a, b) => a.reduce((sum, value, m) => sum + value * (b[m] ?? 0), 0);
    return rows.map((row) => rows.map((other) => entry(row, other)));
  }
}

/** A covariance in units of the states, or in scaled ones. */
const scaled = (P, scale, power) => P.map((row, i) => row.map((value, j) => value * (scale[i] * scale[j]) ** power));

/** An estimate that goes on with the learned motion of the system, and is corrected by each sample. */
class Tracker {
  constructor(tensors, described, C) {
    Object.assign(this, described);
    const names = ["x_offset", "x_scale", "u_scale", "gain", "polynomial", "earlier", "by", "low", "high", "error", "process_noise"];
    for (const name of [...names, "bend", "least_measurement_noise"]) this[name] = tensors[`flow.${name}`]?.data ?? [];
    this.network = new Network(tensors, "flow.", this.activation);
    this.nx = this.x_offset.length;
    this.ny = C.shape[0];
    this.inputs = new Float64Array(this.nx + this.u_scale.length);
    this.monomials = new Float64Array(this.earlier.length).fill(1);
    this.C = Array.from({ length: this.ny }, (_, k) => Array.from(this.x_scale, (scale, i) => C.data[k * this.nx + i] * scale));
    this.mean = this.C.map((_, k) => this.x_offset.reduce((sum, value, i) => sum + C.data[k * this.nx + i] * value, 0));
    this.factors = ["factors", "free_factors"].map((kind) => {
      const found = (name) => tensors[`flow.${kind}.${name}`] ?? tensors[`flow.factors.${name}`];
      return Object.fromEntries(["levels", "ages", "factors", "doubt"].map((name) => [name, found(name)]));
    });
  }

  /** What is assumed of noise; measured is a level for each output. */
  tell(measured, process, shares) {
    const level = Math.max(process, this.least_process_noise);
    this.Q = Array.from(this.error, (error, i) => (level * this.process_noise[i]) ** 2 + error ** 2);
    this.R = measured.map((own, k) => Math.max(own, this.least_measurement_noise[k]) ** 2);
    this.calibrated = this.factors.map((each) => ({
      ages: each.ages.data,
      logs: byAge(each.factors, each, ...shares, Math.log),
      doubts: byAge(each.doubt, each, ...shares),
    }));
  }

  /** Begin with what a map says of z, at an age in samples. */
  begin(map, z, age) {
    this.meanSquare = Infinity; // lost as yet
    this.seen = 0; // samples of which anything was there
    this.trend = new Array(this.ny).fill(0);
    this.supervise(map, z, age);
  }

  get estimate() {
    return Array.from(this.x, (value, i) => this.x_offset[i] + this.x_scale[i] * value);
  }

  #within(s) {
    return s.map((value, i) => Math.min(Math.max(value, this.low[i]), this.high[i]));
  }

  /** Scaled states a sample later. */
  #flow(s, v) {
    const { nx, inputs, monomials, earlier, by, polynomial, gain } = this;
    inputs.set(s);
    inputs.set(v, nx);
    const terms = monomials.length;
    for (let t = 1; t < terms; t++) monomials[t] = monomials[earlier[t]] * inputs[by[t]];
    const said = this.network.run(inputs);
    return s.map((value, i) => {
      let next = value + gain[i] * said[i];
      for (let t = 0; t < terms; t++) next += polynomial[i * terms + t] * monomials[t];
      return next;
    });
  }

  /** Estimate and covariance a sample later, of the mean +- sqrt(nx) times each column of P's factor. */
  #predicted(u) {
    const { nx, x, P, Q } = this;
    const L = P.map(() => new Array(nx).fill(0));
    for (let i = 0; i < nx; i++) {
      for (let j = 0; j <= i; j++) {
        let entry = P[i][j];
        for (let k = 0; k < j; k++) entry -= L[i][k] * L[j][k];
        L[i][j] = i > j ? entry / L[j][j] : entry > 0 ? Math.sqrt(entry) : NaN; // which spreads, and is noticed in advance
      }
    }
    const v = Array.from(this.u_scale, (scale, j) => u[j] / scale);
    const points = [];
    for (let j = 0; j < nx; j++) {
      for (const far of [Math.sqrt(nx), -Math.sqrt(nx)]) {
        points.push(this.#flow(this.#within(x.map((value, i) => value + far * L[i][j])), v));
      }
    }
    const average = (of) => points.reduce((sum, point) => sum + of(point), 0) / points.length;
    const mean = x.map((_, i) => average((point) => point[i]));
    const moved = mean.reduce((sum, value, i) => sum + (value - x[i]) ** 2, 0); // the flow is off by more where that is far
    const added = (i) => (this.bend.length ? Q[i] + (this.bend[i] * moved) ** 2 : Q[i]);
    const spread = P.map((row, i) => row.map((_, j) => average((point) => (point[i] - mean[i]) * (point[j] - mean[j])) + (i === j ? added(i) : 0)));
    return [mean, spread];
  }

  /** Take in a sample, of which outputs may be NaN, after an input; returns it, with what was expected in their place. */
  advance(y, u, before) {
    let [x, P] = this.#predicted(u);
    const expected = this.C.map((row, k) => row.reduce((sum, value, i) => sum + value * x[i], this.mean[k]));
    const whole = y.map((value, k) => (!Number.isNaN(value) ? value : Number.isFinite(expected[k]) ? expected[k] : before[k]));
    let squared = 0, raised = 0, seen = 0;
    const trend = [...this.trend];
    for (let k = 0; k < this.ny; k++) {
      if (Number.isNaN(y[k])) continue;
      const row = this.C[k];
      const across = P.map((entries) => entries.reduce((sum, value, j) => sum + value * row[j], 0));
      const apart = y[k] - row.reduce((sum, value, i) => sum + value * x[i], this.mean[k]);
      const pivot = row.reduce((sum, value, i) => sum + value * across[i], this.R[k]);
      trend[k] += this.trend_share * (apart / Math.sqrt(pivot) - trend[k]);
      raised += trend[k] ** 2;
      squared += apart ** 2 / pivot;
      seen++;
      x = x.map((value, i) => value + (across[i] / pivot) * apart);
      P = P.map((entries, i) => entries.map((value, j) => value - (across[i] / pivot) * across[j]));
    }
    if (![...x, ...P.flat()].every(Number.isFinite)) {
      this.meanSquare = Infinity; // lost
      return whole;
    }
    [this.x, this.P] = [this.#within(x), P];
    if (!seen) return whole;
    const counted = seen / this.ny;
    this.seen++;
    this.trend = trend;
    this.meanSquare += this.share * counted * (squared / seen - this.meanSquare);
    this.trendSquare += this.trend_square_share * counted * ((this.trend_gain * raised) / seen - this.trendSquare);
    if (this.trendSquare > this.trend_limit) { // innovations agree with one another
      this.P = P.map((entries) => entries.map((value) => this.inflation * value));
      [this.trendSquare, this.trend] = [1, trend.map(() => 0)];
    }
    return whole;
  }

  /** Let a map say where to begin, of z at an age in samples: soon after a reset where it is surer, and where all is lost. */
  supervise(map, z, age, told = true) {
    const lost = !(this.meanSquare <= this.limit); // also where it is no number
    if (!lost && (!told || this.seen >= this.window)) return;
    // What came before it was lost may have misled z: the map is no surer than so soon after a reset.
    const P = scaled(map.covariance(z, Math.min(this.seen, this.window) * this.dt), this.x_scale, -1);
    const trace = (matrix) => matrix.reduce((sum, row, i) => sum + row[i], 0);
    if (!lost && !(trace(P) < trace(this.P))) return;
    this.x = this.#within(map.mean(z, age * this.dt).map((value, i) => (value - this.x_offset[i]) / this.x_scale[i]));
    this.P = P;
    if (lost) [this.meanSquare, this.trendSquare, this.trend] = [1, 1, this.trend.map(() => 0)];
  }

  /** The covariance of the estimate's error; the map is that of free motion until an input acts. */
  covariance(map, z, age, free) {
    const { ages, logs, doubts } = this.calibrated[Number(free)];
    const at = (values) => // the larger one of that after so many samples, where some were missing
      Math.max(...[age, this.seen].map((count) => interpolate(count * this.dt, ages, values)));
    const factor = Math.exp(at(logs)), doubt = at(doubts);
    const P = scaled(this.P, this.x_scale, 1);
    if (this.seen >= this.window) return P.map((row, i) => row.map((value, j) => factor * (i === j ? 1 : 1 - doubt) * value));
    const said = map.covariance(z, this.seen * this.dt), estimate = this.estimate;
    const apart = map.mean(z, age * this.dt).map((value, i) => value - estimate[i]);
    return P.map((row, i) => row.map((value, j) => factor * (value + doubt * (said[i][j] + apart[i] * apart[j] - value))));
  }
}

/** Whether samples still fit the estimates: running mean and mean square of y - C x_hat over their limits. */
class Monitor {
  constructor(tensors, { window, warm_up: warmUp }, measured, dt) {
    const [levels, mean, low, high] = ["levels", "mean", "low", "high"].map((name) => tensors[`limits.${name}`]);
    const ny = mean.shape[1], count = levels.shape[0];
    const column = (array, i) => Array.from({ length: count }, (_, k) => array.data[array.shape.length === 2 ? k * ny + i : k]);
    const last = measured.map((_, i) => column(levels, i)[count - 1]);
    const part = measured.map((level, i) => (last[i] > 0 ? level / last[i] : 0));
    const highest = Math.max(...part);
    this.limits = measured.map((own, i) => {
      const noisiest = part[i] === highest ? own : highest * last[i];
      const squares = column(levels, i).map((level) => level ** 2);
      const between = (level, limits) => interpolate(level ** 2, squares, limits); // as variances add up
      const limit = Math.sqrt(between(noisiest, column(mean, i).map((value) => value ** 2)));
      return { mean: limit, low: between(own, column(low, i)), high: between(noisiest, column(high, i)) };
    });
    this.share = -Math.expm1(-dt / window);
    this.silent = Math.round(warmUp / dt);
    this.sound = this.limits.map(({ low: least }, i) => Math.max(measured[i] ** 2, least));
    this.reset();
  }

  reset() {
    this.mean = this.sound.map(() => 0);
    this.square = [...this.sound];
    this.age = 0;
  }

  update(residual, seen) {
    residual.forEach((value, i) => {
      if (!seen[i]) return;
      this.mean[i] += this.share * (value - this.mean[i]);
      this.square[i] += this.share * (value ** 2 - this.square[i]);
    });
    this.age += Number(seen.includes(true));
  }

  get score() {
    if (this.age <= this.silent) return 0;
    const scores = this.limits.map(({ mean, low, high }, i) =>
      Math.max(Math.abs(this.mean[i]) / mean, this.square[i] / high, low / Math.max(this.square[i], 1e-300)));
    return Math.max(...scores);
  }
}

/** Whether there are so many finite numbers, or else entries that are missing where these may be. */
const holds = (values, count, gaps = false) =>
  values?.length === count && Array.from(values).every((value) => Number.isFinite(value) || (gaps && Number.isNaN(value ?? NaN)));

/** What was given in place of numbers, so that a text, a list and a big integer are told from a number. */
const shown = (value) => {
  if (typeof value === "string") return JSON.stringify(value);
  if (typeof value === "bigint") return `${value}n`;
  if (value === null || typeof value !== "object") return String(value);
  return value.length === undefined ? Object.prototype.toString.call(value) : `[${Array.from(value, shown).join(", ")}]`;
};

export class Observer {
  /**
   * @param {ArrayBuffer} buffer what `kkl-gym export MAP --format js` wrote
   */
  constructor(buffer) {
    const { tensors, metadata } = readTensors(buffer);
    this.described = JSON.parse(metadata.kkl_step);
    this.tensors = tensors;
    const { diagonal, early_y: early } = tensors;
    this.nz = diagonal.shape[0];
    this.ny = early.shape[1];
    this.nu = this.described.u.length;
    this.dt = this.described.dt;
    this.C = tensors.C;
    const { driven, free } = this.described.maps;
    this.driven = new InverseMap(tensors, "driven.", driven);
    this.free = free && new InverseMap(tensors, "free.", free);
    this.tracker = this.described.flow ? new Tracker(tensors, { ...this.described.flow, dt: this.dt }, this.C) : null;
    const { measurement_noise: measurement = 0, process_noise: process = 0 } = this.described;
    this.levels = { measurement, process };
    this.tell();
  }

  /** The levels of noise that are assumed: of all outputs or each, and of the state. The monitor begins anew. */
  tell(measurementNoise = this.levels.measurement, processNoise = this.levels.process) {
    this.levels = { measurement: measurementNoise, process: processNoise };
    const ends = this.driven.measurement_noise_max ?? Infinity;
    const each = Array.from({ length: this.ny }, (_, i) => {
      const [level, end] = [measurementNoise, ends].map((values) => (Array.isArray(values) ? values[i] ?? values[0] : values));
      return Math.min(level, end);
    });
    this.driven.tell(each, processNoise);
    this.free?.tell(each, processNoise);
    this.tracker?.tell(each, processNoise, this.driven.shares(each, processNoise));
    const { limits } = this.described;
    this.monitor = limits && this.C ? new Monitor(this.tensors, limits, each, this.dt) : null;
  }

  /** Forget the past and take in the first sample; returns the estimate. */
  reset(y0) {
    if (!holds(y0, this.ny)) throw new Error(`the first sample has ${this.ny} finite outputs, got ${shown(y0)}`);
    const { equilibrium } = this.tensors;
    this.z = new Float64Array(this.nz * (1 + this.nu));
    for (let i = 0; i < this.nz; i++) this.z[i] = this.#dot(equilibrium.data, i, y0);
    this.y = [...y0];
    this.age = 0;
    this.monitor?.reset();
    this.tracker?.begin(this.#map(this.z), this.z, 0);
    return (this.xHat = this.tracker ? this.tracker.estimate : this.#estimate(this.z, 0));
  }

  /**
   * Take in the next sample, null where there is none, and the input that was held before it; returns the estimate.
   *
   * Outputs that are missing, NaN among several, are predicted, which needs a map with a linear output.
   */
  step(y, u = new Array(this.nu).fill(0)) {
    if (!this.y) throw new Error("call reset(y0) before step");
    if (y !== null && !holds(y, this.ny, true)) throw new Error(`a sample has ${this.ny} outputs, NaN where one is missing, or is null, got ${shown(y)}`);
    if (!holds(u, this.nu)) throw new Error(`an input has ${this.nu} finite entries, got ${shown(u)}`);
    const missing = this.y.map((_, i) => Number.isNaN(y?.[i] ?? NaN));
    let now = y && Array.from(y);
    if (this.tracker) {
      now = this.tracker.advance(missing.map((gap, i) => (gap ? NaN : y[i])), u, this.y);
    } else if (missing.includes(true)) {
      if (!this.C) throw new Error("this map holds no linear output y = C x to predict with: pass the last sample again");
      const filled = (xHat) => this.y.map((_, i) => (missing[i] ? this.#dot(this.C.data, i, xHat) : y[i]));
      const guess = this.#advanced(filled(this.#estimate(this.z, this.age * this.dt)), u);
      now = filled(this.#estimate(guess, (this.age + 1) * this.dt));
    }
    this.z = this.#advanced(now, u);
    this.y = [...now];
    this.age++;
    this.tracker?.supervise(this.#map(this.z), this.z, this.age, missing.includes(false));
    this.xHat = this.tracker ? this.tracker.estimate : this.#estimate(this.z, this.age * this.dt);
    if (this.monitor && y !== null) {
      this.monitor.update(this.y.map((value, i) => value - this.#dot(this.C.data, i, this.xHat)), missing.map((gap) => !gap));
    }
    return this.xHat;
  }

  /** Above 1 the samples do not fit the estimates; null without limits to judge by. */
  get score() {
    return this.monitor ? this.monitor.score : null;
  }

  /** Covariance of the estimate's error, rows of numbers; null where the map holds no error bars. */
  get covariance() {
    const map = this.#map(this.z);
    if (this.tracker) return this.tracker.covariance(map, this.z, this.age, !this.z.some((value, i) => i >= this.nz && value !== 0));
    return map.spread ? map.covariance(this.z, this.age * this.dt) : null;
  }

  /** Row i of a matrix times a vector. */
  #dot(matrix, i, vector) {
    let sum = 0;
    for (let j = 0; j < vector.length; j++) sum += matrix[i * vector.length + j] * vector[j];
    return sum;
  }

  #map(z) {
    return this.free && !z.some((value, i) => i >= this.nz && value !== 0) ? this.free : this.driven;
  }

  #estimate(z, age) {
    return this.#map(z).mean(z, age);
  }

  /** z one sample later. */
  #advanced(y, u) {
    const { diagonal, mixing, mixing_at: at, early_y: early, late_y: late, held_u: held } = this.tensors;
    const next = new Float64Array(this.z.length);
    for (let block = 0; block <= this.nu; block++) {
      const first = block * this.nz;
      for (let i = 0; i < this.nz; i++) {
        next[first + i] = diagonal.data[i] * this.z[first + i];
        if (block === 0) next[i] += this.#dot(early.data, i, this.y) + this.#dot(late.data, i, y);
        else next[first + i] += held.data[i] * u[block - 1];
      }
      for (let k = 0; mixing && k < mixing.data.length; k++) {
        next[first + at.data[2 * k]] += mixing.data[k] * this.z[first + at.data[2 * k + 1]];
      }
    }
    return next;
  }
}
