// node replay.mjs kkl_observer.js STEP.safetensors < {"y": ..., "u": ..., "noise": ...} > {"x_hat": ..., ...}
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [module, constants] = process.argv.slice(2);
const { Observer } = await import(pathToFileURL(module));
const { y, u, noise } = JSON.parse(readFileSync(0, "utf8"));
const bytes = readFileSync(constants);
const observer = new Observer(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
if (noise) observer.tell(...noise);
const found = { x_hat: [], score: [], covariance: [] };
for (let k = 0; k < y.length; k++) {
  found.x_hat.push(k ? observer.step(y[k], u[k - 1]) : observer.reset(y[k])); // null is missing, as NaN is
  found.score.push(observer.score);
  found.covariance.push(observer.covariance);
}
process.stdout.write(JSON.stringify(found));
