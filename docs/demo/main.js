// Controls and the clock.

import { Portrait, Traces } from "./drawing.js";
import { Observer } from "./kkl_observer.js";
import { System } from "./systems.js";
import { World } from "./world.js";

const MOST_STEPS = 60; // of a frame: a page that was hidden does not make up for it
const NOTES = {
  none: "Every sample is the output and noise.",
  bias: "A fifth of the output's range is added to every sample.",
  frozen: "The sensor repeats its last value.",
  dead: "The sensor reads 0.",
  missing: "Samples are missing. The observer knows and continues by its own prediction.",
};
const $ = (id) => document.getElementById(id);

/** How long frames took: for measurements, milliseconds of work and of waiting. */
export const statistics = { frames: 0, busy: 0, longest: 0, since: performance.now() };

const worlds = new Map();
const portrait = new Portrait($("portrait")), traces = new Traces($("traces"));
let world, paused = matchMedia("(prefers-reduced-motion: reduce)").matches;

async function load() {
  const systems = (await (await fetch("systems.json")).json()).map((described) => new System(described));
  await Promise.all(systems.map(async (system) => {
    const answer = await fetch(`${system.name}_step.safetensors`);
    if (!answer.ok) throw new Error(`${answer.url}: ${answer.status}`);
    worlds.set(system.name, new World(system, new Observer(await answer.arrayBuffer())));
  }));
}

const chosen = (group) => document.querySelector(`input[name=${group}]:checked`).value;
const speed = () => 2 ** Number($("speed").value);

/** A system is chosen: its world goes on where it was. */
function choose() {
  world = worlds.get(chosen("system"));
  const { system } = world;
  $("equations").replaceChildren(...system.shown.map((text) => Object.assign(document.createElement("span"), { textContent: text })));
  Object.assign($("noise"), { max: system.measurement_noise_max, value: world.noise });
  Object.assign($("process"), { max: system.process_noise_max, value: world.process });
  $("speed").value = Math.log2(system.speed);
  controlled();
  const measured = `x${system.measured + 1}`;
  const hidden = system.scale.map((_, i) => `x${i + 1}`).filter((name) => name !== measured).join(" and ");
  $("portrait").setAttribute("aria-label", `Phase portrait: the true state, and its estimate from noisy samples of ${measured}`);
  $("traces").setAttribute("aria-label", `True states and estimates over time; ${measured} is measured, ${hidden} never; below, the fault score`);
  $("given").hidden = !system.portrait.includes(system.measured);
  portrait.show(world);
  traces.show(world);
}

/** The controls' values act. */
function controlled() {
  const [noise, process] = [Number($("noise").value), Number($("process").value)];
  if (noise !== world.noise || process !== world.process) world.levels = [noise, process];
  world.input = { kind: chosen("input"), level: Number($("level").value) };
  world.fault = chosen("fault");
  $("noise-value").value = `σ = ${noise.toFixed(2)}`;
  $("process-value").value = process.toFixed(3);
  $("level-value").value = `${(world.input.level * world.system.u_max[0]).toFixed(1).replace("-", "−")}`;
  $("speed-value").value = `${speed().toFixed(speed() < 1 ? 2 : 1)} ×`;
  $("fault-note").textContent = NOTES[world.fault];
}

function pause(whether) {
  paused = whether;
  $("pause").textContent = paused ? "Play" : "Pause";
  $("pause").setAttribute("aria-pressed", String(paused));
}

function restarted(x0) {
  world.restart(x0);
  draw();
}

function draw() {
  portrait.draw();
  traces.draw();
}

/** Twice a second, for people and for screen readers that ask. */
function say() {
  const percent = (100 * world.error(2)).toFixed(1);
  const words = `off by ${percent}\u00a0% of the state’s size`;
  $("error").innerHTML = `${world.time < 2 ? "The observer was just switched on: it is" : "Over the last two seconds the estimate is"} <b>${words}</b>.`;
}

let before = performance.now(), owed = 0, said = 0;
function frame(now) {
  const begun = performance.now();
  if (!paused) {
    owed = Math.min(owed + ((now - before) / 1000) * speed() / world.system.dt, MOST_STEPS);
    for (; owed >= 1; owed--) world.step();
    draw();
  }
  before = now;
  if (now - said > 500) {
    say();
    said = now;
  }
  const took = performance.now() - begun;
  statistics.frames++;
  statistics.busy += took;
  statistics.longest = Math.max(statistics.longest, took);
  requestAnimationFrame(frame);
}

function listen() {
  $("systems").addEventListener("change", choose);
  $("controls").addEventListener("input", (event) => {
    if (event.target.id === "level" && chosen("input") === "off") document.querySelector("input[value=hand]").checked = true;
    controlled();
  });
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  $("pause").addEventListener("click", () => pause(!paused));
  $("restart").addEventListener("click", () => restarted(world.start));
  $("start").addEventListener("click", () => restarted());
  $("portrait").addEventListener("click", ({ offsetX, offsetY }) => restarted(portrait.stateAt(offsetX, offsetY)));
  document.addEventListener("keydown", (event) => {
    if (event.key === " " && event.target === document.body) {
      event.preventDefault();
      pause(!paused);
    }
  });
}

try {
  await load();
  listen();
  choose();
  pause(paused);
  $("status").remove();
  requestAnimationFrame(frame);
} catch (error) {
  $("status").textContent = `The demo could not start: ${error.message}. Build it with python docs/demo/build.py.`;
  throw error;
}
