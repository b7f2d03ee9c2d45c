// The page: choose a frame, have it recognized, look at its objects.

import { showDetails } from "./details.js";
import { element, percent, rgb } from "./drawing.js";
import { ink, Overlay, paints } from "./overlay.js";
import * as service from "./service.js";

const FIELDS = ["color", "depth", "labels", "intrinsics"];
const at = (id) => document.getElementById(id);

const overlay = new Overlay(at("overlay"), select);
let about = null; // the model and the mean colours of its regions
let frame = null; // the answer on show
let running = new AbortController();

function say(text, busy = false) {
  at("status").textContent = text;
  at("status").toggleAttribute("data-busy", busy);
  at("status").removeAttribute("data-empty");
}

function markField(id, message) {
  at(`${id}-error`).textContent = message;
  if (message) at(id).setAttribute("aria-invalid", "true");
  else at(id).removeAttribute("aria-invalid");
}

function clearProblems() {
  [...FIELDS, "token"].forEach((id) => markField(id, ""));
  at("problem").hidden = true;
}

/** Say what went wrong: beside the field concerned if it is on the page, else above the result. */
function tell(problem, fields = []) {
  say("");
  if (problem.status === 401) {
    at("token-section").hidden = false;
    // Nobody has done anything wrong before a token was asked for.
    if (at("token").value) markField("token", problem.message);
    at("token").focus();
  } else if (fields.includes(problem.field)) {
    markField(problem.field, problem.message);
    at(problem.field).focus();
  } else {
    at("problem").textContent = problem.message;
    at("problem").hidden = false;
  }
  if (!(problem instanceof service.Problem)) throw problem;
}

async function recognize(what, fileSource, fields) {
  running.abort();
  const { signal } = (running = new AbortController());
  clearProblems();
  say(`Recognizing ${what}`, true);
  at("result").setAttribute("aria-busy", "true");
  try {
    about ??= await load();
    const files = await fileSource();
    const answer = await service.explain(files, signal);
    const bitmap = await createImageBitmap(files.color, { imageOrientation: "none" });
    if (!signal.aborted) show(what, answer, bitmap);
  } catch (problem) {
    if (signal.aborted) return;
    hideResult();
    tell(problem, fields);
  } finally {
    if (!signal.aborted) at("result").removeAttribute("aria-busy");
  }
}

function hideResult() {
  frame = null;
  at("result").hidden = at("details").hidden = true;
}

function show(what, answer, bitmap) {
  frame = answer;
  const { instances, timings } = answer;
  const named = instances.filter(({ name }) => name !== null);
  const count = `${instances.length} ${instances.length === 1 ? "object" : "objects"}`;
  const unnamed = instances.length - named.length;
  if (!instances.length) say(`${what}: no objects; the label image is 0 everywhere.`);
  else say(`${what}: ${count}${unnamed ? `, ${unnamed} of them not recognized` : ""}.`);
  at("result").hidden = false;
  at("details").hidden = true;
  const colors = paints(instances);
  at("objects").replaceChildren(...instances.map((instance, k) => element("li", {}, objectButton(instance, colors[k]))));
  const stages = Object.entries(timings).map(([stage, ms]) => `${stage}\u00a0${ms.toFixed(ms < 10 ? 1 : 0)}\u00a0ms`);
  at("timings").textContent = stages.join(" · ");
  const first = named[0] ?? instances[0];
  overlay.show(bitmap, instances, answer.label_map, first?.label);
  if (first) select(first.label);
  if (at("status").getBoundingClientRect().top > innerHeight / 2) at("status").scrollIntoView();
}

function objectButton(instance, color) {
  const { label, name, confidence, classifier, occluded, unrecognized } = instance;
  const facts = name === null ? unrecognized : `${classifier.toUpperCase()} is surer${occluded ? " · hidden in part" : ""}`;
  const swatch = element("span", { className: "swatch" }, label);
  swatch.style.background = rgb(color);
  swatch.style.color = ink(color);
  const button = element(
    "button",
    { type: "button", onclick: () => select(label) },
    swatch,
    element("span", { className: "name" }, name ?? "unrecognized"),
    element("span", { className: "sure" }, name === null ? "" : percent(confidence)),
    element("span", { className: "facts hint" }, facts),
  );
  button.dataset.label = label;
  return button;
}

function select(label) {
  for (const button of at("objects").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", button.dataset.label === String(label));
  }
  overlay.select(label);
  showDetails(frame.instances.find((one) => one.label === label), about.model, about.regions);
}

async function load() {
  const [model, network] = await Promise.all([service.model(), service.colornet()]);
  at("token-section").hidden = true;
  at("model-title").textContent = `The model knows ${model.classes.length} objects`;
  at("classes").replaceChildren(...model.classes.map((name) => element("li", {}, name)));
  at("model").hidden = false;
  return { model, regions: network.mean_rgb };
}

async function showSamples() {
  const buttons = (await service.samples()).map(({ folder, title }) => {
    const picture = element("img", { src: `samples/${folder}/color.jpg`, alt: "", loading: "lazy" });
    const button = element("button", { type: "button" }, picture, element("span", {}, title));
    button.setAttribute("aria-pressed", "false");
    button.addEventListener("click", () => {
      press(button);
      recognize(title, () => service.sampleFiles(folder), []);
    });
    return button;
  });
  at("samples").replaceChildren(...buttons);
}

function press(chosen) {
  for (const button of at("samples").children) button.setAttribute("aria-pressed", button === chosen);
}

at("upload-form").addEventListener("submit", (event) => {
  event.preventDefault();
  clearProblems();
  const files = Object.fromEntries(FIELDS.map((name) => [name, at(name).files[0]]));
  const missing = FIELDS.filter((name) => !files[name]);
  if (missing.length) {
    missing.forEach((name) => markField(name, "Choose a file."));
    at(missing[0]).focus();
    return;
  }
  press(null);
  recognize(files.color.name, async () => files, FIELDS);
});

at("token-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  clearProblems();
  service.useToken(at("token").value.trim());
  try {
    about = await load();
    say("The token is accepted. Choose a frame.");
  } catch (problem) {
    tell(problem);
  }
});

async function watchReady() {
  const state = (name, text) => {
    at("ready").dataset.state = name;
    at("ready").textContent = text;
  };
  try {
    await service.ready();
    state("ready", "Ready");
  } catch (problem) {
    if (problem.status === 503) state("waiting", "Starting");
    else state("failed", "No answer");
    setTimeout(watchReady, 2000);
  }
}

watchReady();
showSamples().catch(tell);
load().then((found) => (about = found), tell);
