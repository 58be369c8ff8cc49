// What the page draws: a phase portrait, and the states over time.

const TRAIL = 0.55; // of the traces' seconds, which the portrait's trails show
const FADES = 14; // steps in which a trail fades
const LINES = [["x", "truth", 4], ["xHat", "estimate", 1.5]]; // so that both are seen where they are the same
const SCORES = 2.5; // that the lane of the score holds

/** Colours and fonts as the style sheet has them. */
function looks() {
  const style = getComputedStyle(document.documentElement);
  const names = ["ink", "truth", "soft", "rule", "estimate", "sample", "alarm", "fault", "flow", "serif", "sans"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Round numbers within a range, about `count` of them. */
function ticks([low, high], count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((value) => value >= rough);
  const found = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) found.push(Number((i * step).toPrecision(6)));
  return found;
}

const shownNumber = (value) => String(value).replace("-", "−");
const name = (i) => `x${"₁₂₃"[i]}`;

/** A canvas as sharp as the screen, redrawn when its size or the colours change. */
class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => this.#fit()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#fit());
    this.#fit();
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(devicePixelRatio, 2);
    Object.assign(this, { width, height, ratio, look: looks() });
    Object.assign(this.canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    this.still = null;
    if (this.world) this.draw();
  }

  /** Show a world from here on. */
  show(world) {
    this.world = world;
    this.still = null;
    this.draw();
  }

  draw() {
    const { context, ratio } = this;
    if (!this.width || !this.height) return;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    if (!this.still) {
      this.still = new OffscreenCanvas(this.canvas.width, this.canvas.height);
      const back = this.still.getContext("2d");
      back.scale(ratio, ratio);
      this.background(back);
    }
    context.drawImage(this.still, 0, 0);
    context.scale(ratio, ratio);
    this.foreground(context);
  }

  text(context, words, x, y, { colour = this.look.soft, font = "sans", size = 12, italic = false, align = "left", base = "alphabetic" } = {}) {
    Object.assign(context, {
      font: `${italic ? "italic " : ""}${size}px ${this.look[font]}`, fillStyle: colour, textAlign: align, textBaseline: base,
    });
    context.fillText(words, x, y);
  }
}

/** Every so many samples that fewer than twice `count` are left; the same ones as time goes on, and always the last. */
function thinned(samples, count) {
  const stride = Math.max(1, Math.floor(samples.length / count));
  return samples.filter(({ k }, i) => k % stride === 0 || i === samples.length - 1);
}

function line(context, points) {
  context.beginPath();
  for (const [x, y] of points) context.lineTo(x, y);
  context.stroke();
}

export class Portrait extends Picture {
  get axes() {
    const [i, j] = this.world.system.portrait, { range } = this.world.system;
    const [left, bottom] = [34, 26], right = this.width - 10, top = 10, low = this.height - bottom;
    const across = ([a, b], from, to) => (value) => from + ((value - a) / (b - a)) * (to - from);
    return { i, j, left, right, top, low, X: across(range[i], left, right), Y: across(range[j], low, top) };
  }

  /** The state at a point of the canvas; states that the portrait does not show stay as they are. */
  stateAt(px, py) {
    const { i, j, left, right, top, low } = this.axes, { range, bounds } = this.world.system, x = [...this.world.x];
    x[i] = range[i][0] + ((px - left) / (right - left)) * (range[i][1] - range[i][0]);
    x[j] = range[j][0] + ((py - low) / (top - low)) * (range[j][1] - range[j][0]);
    return x.map((value, k) => Math.min(Math.max(value, bounds[k][0]), bounds[k][1]));
  }

  background(context) {
    const { i, j, left, right, top, low, X, Y } = this.axes, { system, measured } = this.world, { look } = this;
    context.save();
    context.beginPath();
    context.rect(left, top, right - left, low - top);
    context.clip();
    context.strokeStyle = look.flow;
    context.lineWidth = 1;
    for (const motion of system.flow) line(context, motion.map((x) => [X(x[i]), Y(x[j])]));
    context.restore();
    context.strokeStyle = look.rule;
    line(context, [[left, top], [left, low], [right, low]]);
    for (const value of ticks(system.range[i], this.width / 90)) {
      this.text(context, shownNumber(value), X(value), low + 14, { size: 11, align: "center" });
    }
    for (const value of ticks(system.range[j], this.height / 80)) {
      this.text(context, shownNumber(value), left - 6, Y(value), { size: 11, align: "right", base: "middle" });
    }
    const called = (k) => `${name(k)}${k === measured ? " measured" : ""}`;
    this.text(context, called(i), right, low - 8, { font: "serif", size: 15, italic: true, align: "right", colour: look.ink });
    this.text(context, called(j), left + 8, top + 12, { font: "serif", size: 15, italic: true, colour: look.ink });
  }

  foreground(context) {
    const { i, j, left, right, top, low, X, Y } = this.axes, { world, look } = this;
    const recent = thinned(world.history.slice(-Math.round((TRAIL * world.system.seconds) / world.system.dt)), 300);
    const now = recent.at(-1);
    context.save();
    context.beginPath();
    context.rect(left, top, right - left, low - top);
    context.clip();
    if (now.y !== null && (world.measured === i || world.measured === j)) { // all that the observer is given
      context.strokeStyle = look.sample;
      context.globalAlpha = 0.55;
      context.lineWidth = 1;
      const at = world.measured === i ? [[X(now.y), top], [X(now.y), low]] : [[left, Y(now.y)], [right, Y(now.y)]];
      line(context, at);
    }
    for (const [key, colour, width] of LINES) {
      context.strokeStyle = look[colour];
      context.lineWidth = width;
      const points = recent.map((sample) => [X(sample[key][i]), Y(sample[key][j])]);
      for (let part = 0; part < FADES; part++) {
        const [from, to] = [part, part + 1].map((edge) => Math.round((edge * (points.length - 1)) / FADES));
        context.globalAlpha = ((part + 1) / FADES) ** 1.6;
        line(context, points.slice(from, to + 1));
      }
    }
    context.globalAlpha = 1;
    const [truth, guess] = [now.x, now.xHat].map((x) => [X(x[i]), Y(x[j])]);
    if (now.std) this.#region(context, now, X, Y, i, j);
    context.strokeStyle = look.estimate;
    context.lineWidth = 1;
    line(context, [truth, guess]); // the error
    this.#dot(context, truth, look.ink, true);
    this.#dot(context, guess, look.estimate, false);
    context.restore();
  }

  #dot(context, [x, y], colour, full) {
    context.beginPath();
    context.arc(x, y, full ? 5 : 7, 0, 2 * Math.PI);
    if (full) {
      context.fillStyle = colour;
      context.fill();
    } else {
      context.lineWidth = 2.25;
      context.strokeStyle = colour;
      context.stroke();
    }
  }

  /** Two standard deviations on either side, of each state. */
  #region(context, { xHat, std }, X, Y, i, j) {
    context.fillStyle = this.look.estimate;
    context.globalAlpha = 0.18;
    context.beginPath();
    context.ellipse(X(xHat[i]), Y(xHat[j]), Math.abs(X(2 * std[i]) - X(0)), Math.abs(Y(2 * std[j]) - Y(0)), 0, 0, 2 * Math.PI);
    context.fill();
    context.globalAlpha = 1;
  }
}

export class Traces extends Picture {
  /** Where each state's lane lies, and the score's below them. */
  get lanes() {
    const { system } = this.world, foot = 24, gap = 26, least = 46;
    const tall = (this.height - foot - least - gap * (system.nx + 1)) / system.nx;
    const lanes = system.range.map((range, i) => ({ range, i, top: gap + i * (tall + gap), tall }));
    const score = { range: [0, SCORES], top: this.height - foot - least, tall: least };
    const left = 30, right = this.width - 8;
    for (const lane of [...lanes, score]) {
      const [low, high] = lane.range;
      lane.Y = (value) => lane.top + lane.tall * (1 - (value - low) / (high - low));
    }
    return { lanes, score, left, right };
  }

  background(context) {
    const { lanes, score, left, right } = this.lanes, { look, world } = this;
    context.lineWidth = 1;
    for (const lane of lanes) {
      context.strokeStyle = look.rule;
      for (const value of ticks(lane.range, 4)) {
        line(context, [[left, lane.Y(value)], [right, lane.Y(value)]]);
        this.text(context, shownNumber(value), left - 6, lane.Y(value), { size: 11, align: "right", base: "middle" });
      }
      const measured = lane.i === world.measured;
      this.text(context, name(lane.i), left, lane.top - 7, { font: "serif", size: 16, italic: true, colour: look.ink });
      this.text(context, measured ? "measured" : "never measured", left + 24, lane.top - 7, { size: 12 });
    }
    context.strokeStyle = look.rule;
    line(context, [[left, score.Y(0)], [right, score.Y(0)]]);
    context.setLineDash([4, 3]);
    context.strokeStyle = look.alarm;
    line(context, [[left, score.Y(1)], [right, score.Y(1)]]);
    context.setLineDash([]);
    this.text(context, "1", left - 6, score.Y(1), { size: 11, align: "right", base: "middle", colour: look.alarm });
    this.text(context, "fault score", left, score.top - 7, { size: 12, colour: look.ink });
  }

  foreground(context) {
    const { lanes, score, left, right } = this.lanes, { world, look } = this, { seconds, dt } = world.system;
    const now = world.time, from = Math.max(0, now - seconds);
    const all = world.history.slice(-Math.round(seconds / dt) - 1), shown = thinned(all, (right - left) / 2);
    const T = (t) => left + ((t - from) / seconds) * (right - left);
    this.#faults(context, shown, T, lanes[0].top - 4, score.Y(0));
    for (const lane of lanes) {
      context.save();
      context.beginPath();
      context.rect(left, lane.top - 4, right - left, lane.tall + 8);
      context.clip();
      if (lane.i === world.measured) this.#samples(context, thinned(all, right - left), T, lane.Y);
      if (shown.at(-1).std) this.#band(context, shown, T, lane);
      for (const [key, colour, width] of LINES) {
        context.strokeStyle = look[colour];
        context.lineWidth = width;
        line(context, shown.map((sample) => [T(sample.t), lane.Y(sample[key][lane.i])]));
      }
      context.restore();
    }
    this.#score(context, shown, T, score);
    for (const value of ticks([from, from + seconds], this.width / 110)) {
      this.text(context, `${value} s`, Math.min(T(value), right - 6), this.height - 6, { size: 11, align: "center" });
    }
  }

  #samples(context, shown, T, Y) {
    context.fillStyle = this.look.sample;
    context.beginPath();
    for (const { t, y } of shown) if (y !== null) context.rect(T(t) - 0.75, Y(y) - 0.75, 1.5, 1.5);
    context.fill();
  }

  #band(context, shown, T, { i, Y }) {
    context.fillStyle = this.look.estimate;
    context.globalAlpha = 0.18;
    context.beginPath();
    for (const { t, xHat, std } of shown) context.lineTo(T(t), Y(xHat[i] + 2 * std[i]));
    for (const { t, xHat, std } of [...shown].reverse()) context.lineTo(T(t), Y(xHat[i] - 2 * std[i]));
    context.fill();
    context.globalAlpha = 1;
  }

  /** Where the sensor was at fault. */
  #faults(context, shown, T, top, bottom) {
    context.fillStyle = this.look.fault;
    for (let k = 0; k < shown.length; k++) {
      if (shown[k].fault === "none") continue;
      const begun = k;
      while (k + 1 < shown.length && shown[k + 1].fault !== "none") k++;
      context.fillRect(T(shown[begun].t), top, Math.max(T(shown[k].t) - T(shown[begun].t), 1), bottom - top);
    }
  }

  #score(context, shown, T, { Y, top }) {
    const { look } = this, points = shown.map((sample) => [T(sample.t), Y(Math.min(sample.score ?? 0, SCORES))]);
    const alarm = (context.globalAlpha = 1) && shown.at(-1).score > 1;
    context.fillStyle = look.alarm;
    context.beginPath(); // the part above the limit
    points.forEach(([x, y]) => context.lineTo(x, Math.min(y, Y(1))));
    context.lineTo(points.at(-1)[0], Y(1));
    context.lineTo(points[0][0], Y(1));
    context.globalAlpha = 0.35;
    context.fill();
    context.globalAlpha = 1;
    context.strokeStyle = alarm ? look.alarm : look.soft;
    context.lineWidth = 1.5;
    line(context, points);
    const { score } = shown.at(-1);
    const words = score === 0 ? "not judged yet" : score > 1 ? `${score.toFixed(1)}: the samples do not fit` : score.toFixed(2);
    this.text(context, words, 100, top - 7, { size: 12, colour: alarm ? look.alarm : look.soft });
  }
}
