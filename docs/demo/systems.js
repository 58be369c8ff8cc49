// The four systems: x' = f(x) + G u + w, and their simulation. Everything but the equations comes from systems.json.

const EQUATIONS = {
  reverse_duffing: {
    f: ([x1, x2], { a, b }) => [a * x2 ** 3, -b * x1],
    shown: ["x₁′ = x₂³", "x₂′ = −x₁ + u"],
    range: [[-2.9, 2.9], [-2.7, 2.7]], // of each state, as it is shown
    seconds: 14, // that the traces show
    speed: 1, // of the clock
  },
  van_der_pol: {
    f: ([x1, x2], { mu }) => [x2, mu * (1 - x1 ** 2) * x2 - x1],
    shown: ["x₁′ = x₂", "x₂′ = 3 (1 − x₁²) x₂ − x₁ + u"],
    range: [[-3.2, 3.2], [-8, 8]],
    seconds: 16,
    speed: 1.5,
  },
  rossler: {
    f: ([x1, x2, x3], { a, b, c }) => [-x2 - x3, x1 + a * x2, b + x3 * (x1 - c)],
    shown: ["x₁′ = −x₂ − x₃ + u", "x₂′ = x₁ + 0.2 x₂", "x₃′ = 0.2 + x₃ (x₁ − 5.7)"],
    range: [[-13, 16], [-14, 12], [-3, 27]],
    seconds: 30,
    speed: 3,
  },
  lorenz: {
    f: ([x1, x2, x3], { sigma, rho, beta }) => [sigma * (x2 - x1), x1 * (rho - x3) - x2, x1 * x2 - beta * x3],
    shown: ["x₁′ = 10 (x₂ − x₁)", "x₂′ = x₁ (28 − x₃) − x₂ + u", "x₃′ = x₁ x₂ − 8⁄3 x₃"],
    range: [[-24, 24], [-31, 31], [-2, 54]],
    seconds: 7,
    speed: 0.6,
  },
};
const SUBSTEPS = 8; // of a sampling interval: Van der Pol is stiff far from its cycle

/** A system of systems.json with its equations and the page's settings. */
export class System {
  constructor(described) {
    Object.assign(this, described, EQUATIONS[described.name]);
    this.nx = this.scale.length;
    this.flow = this.#lines();
  }

  /** The state after an interval dt, with input u and noise w held: fixed steps of the classical Runge–Kutta method. */
  advance(x, u, w, dt = this.dt) {
    const constant = this.G.map((row, i) => row.reduce((sum, g, j) => sum + g * u[j], w[i]));
    const slope = (at) => this.f(at, this.parameters).map((value, i) => value + constant[i]);
    const moved = (k, h) => x.map((value, i) => value + h * k[i]);
    const h = dt / SUBSTEPS;
    for (let n = 0; n < SUBSTEPS; n++) {
      const k1 = slope(x), k2 = slope(moved(k1, h / 2)), k3 = slope(moved(k2, h / 2)), k4 = slope(moved(k3, h));
      x = x.map((value, i) => value + (h / 6) * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]));
    }
    return x;
  }

  inside(x) {
    return x.every((value, i) => value >= this.bounds[i][0] && value <= this.bounds[i][1]);
  }

  /** A start, uniform in the visible part of the training box. */
  start(random) {
    return this.X.map(([low, high], i) => {
      const [least, most] = [Math.max(low, this.range[i][0]), Math.min(high, this.range[i][1])];
      return least + (most - least) * random();
    });
  }

  /** Lines that show where the flow goes without input: short ones from everywhere in the plane, or long ones. */
  #lines() {
    const random = uniform(1);
    const from = (box) => box.map(([low, high]) => low + (high - low) * random());
    const flat = this.nx === 2, length = this.seconds * (flat ? 0.045 : 2);
    const motions = Array.from({ length: flat ? 160 : 4 }, () => this.#motion(from(flat ? this.range : this.X), length));
    return flat ? motions : motions.map((motion) => motion.slice(motion.length / 3));
  }

  #motion(x, seconds) {
    const still = [this.u_max.map(() => 0), this.scale.map(() => 0)], motion = [x];
    for (let t = 0; t < seconds && this.inside(x); t += 0.0125) motion.push((x = this.advance(x, ...still, 0.0125)));
    return motion;
  }
}

/** Numbers uniform in [0, 1), by mulberry32. */
export function uniform(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), state | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}

/** Standard normal numbers, by Box and Muller. */
export function normal(random) {
  return () => Math.sqrt(-2 * Math.log(1 - random())) * Math.cos(2 * Math.PI * random());
}
