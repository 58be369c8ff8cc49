// A plant, its sensor and an observer of it, sample by sample.

import { normal, uniform } from "./systems.js";

const BIAS = 0.2; // of the output's range
const KEPT = 4096; // samples that are remembered
export const FAULTS = ["none", "bias", "frozen", "dead", "missing"];

export class World {
  constructor(system, observer, seed = Date.now()) {
    Object.assign(this, { system, observer });
    this.random = uniform(seed);
    this.normal = normal(this.random);
    this.levels = [system.measurement_noise, system.process_noise];
    this.input = { kind: "off", level: 0.5 };
    this.fault = "none";
    this.measured = system.measured; // the index of the state that is the output
    this.restart();
  }

  /** Tell plant and observer the levels of noise. */
  set levels([noise, process]) {
    Object.assign(this, { noise, process });
    this.observer.tell(noise, process);
  }

  restart(x0 = this.system.start(this.random)) {
    this.x = this.start = x0;
    this.count = 0; // of samples
    this.escaped = false;
    this.history = [];
    this.held = null;
    const y = this.#sample() ?? x0[this.measured] + this.noise * this.normal(); // an observer begins with a sample
    this.observer.reset([y]);
    this.#remember(y, [0]);
  }

  get time() {
    return this.count * this.system.dt;
  }

  /** One sampling interval. */
  step() {
    const { system, random } = this;
    const u = this.#input();
    const w = system.scale.map((scale) => this.process * scale * (2 * random() - 1));
    const x = system.advance(this.x, u, w);
    if (!system.inside(x)) {
      this.restart();
      this.escaped = true;
      return;
    }
    this.x = x;
    this.count++;
    const y = this.#sample();
    this.observer.step(y === null ? null : [y], u);
    this.#remember(y, u);
  }

  /** Root mean square error of the last seconds, over the states' scales. */
  error(seconds) {
    const last = this.history.slice(-Math.round(seconds / this.system.dt));
    const squares = last.map(({ x, xHat }) => x.reduce((sum, value, i) => sum + ((xHat[i] - value) / this.system.scale[i]) ** 2, 0));
    return Math.sqrt(squares.reduce((a, b) => a + b, 0) / (last.length * this.system.nx));
  }

  #input() {
    const { kind, level } = this.input, u = this.system.u_max[0];
    if (kind === "hand") return [level * u];
    return [kind === "sine" ? level * u * Math.sin((2 * Math.PI * this.time) / (this.system.seconds / 5)) : 0];
  }

  #sample() {
    const noisy = this.x[this.measured] + this.noise * this.normal();
    if (this.fault !== "frozen" || this.held === null) this.held = noisy;
    const [low, high] = this.system.range[this.measured];
    return { bias: noisy + BIAS * (high - low), frozen: this.held, dead: 0, missing: null, none: noisy }[this.fault];
  }

  #remember(y, u) {
    const { observer, x, time, fault } = this;
    const covariance = observer.covariance;
    const std = covariance && covariance.map((row, i) => Math.sqrt(row[i]));
    this.history.push({ k: this.count, t: time, x, xHat: observer.xHat, y, u, score: observer.score, std, fault });
    if (this.history.length > 2 * KEPT) this.history = this.history.slice(-KEPT);
  }
}
