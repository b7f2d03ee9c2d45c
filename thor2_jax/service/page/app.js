// Main module of the page: choose a frame, recognize it, show its objects.

import { showDetails } from "./details.js";
import { element, percent, rgb } from "./drawing.js";
import { ink, Overlay, paints } from "./overlay.js";
import * as service from "./service.js";

const FIELDS = ["color", "depth", "labels", "intrinsics"];
const byId = (id) => document.getElementById(id);

const overlay = new Overlay(byId("overlay"), select);
let loaded = null; // The model and the mean colours of its colour regions.
let frame = null; // The answer that is shown.
let currentRequest = new AbortController();

function setStatus(text, busy = false) {
  byId("status").textContent = text;
  byId("status").toggleAttribute("data-busy", busy);
  byId("status").removeAttribute("data-empty");
}

function markField(id, message) {
  byId(`${id}-error`).textContent = message;
  if (message) byId(id).setAttribute("aria-invalid", "true");
  else byId(id).removeAttribute("aria-invalid");
}

function clearProblems() {
  [...FIELDS, "token"].forEach((id) => markField(id, ""));
  byId("problem").hidden = true;
}

/** Show an error beside the field concerned if it is on the page, otherwise above the result. */
function showProblem(problem, fields = []) {
  setStatus("");
  if (problem.status === 401) {
    byId("token-section").hidden = false;
    // The first request is sent without a token: that is not an error of the user.
    if (byId("token").value) markField("token", problem.message);
    byId("token").focus();
  } else if (fields.includes(problem.field)) {
    markField(problem.field, problem.message);
    byId(problem.field).focus();
  } else {
    byId("problem").textContent = problem.message;
    byId("problem").hidden = false;
  }
  if (!(problem instanceof service.Problem)) throw problem;
}

async function recognize(what, fileSource, fields) {
  currentRequest.abort();
  const { signal } = (currentRequest = new AbortController());
  clearProblems();
  setStatus(`Recognizing ${what}`, true);
  byId("result").setAttribute("aria-busy", "true");
  try {
    loaded ??= await load();
    const files = await fileSource();
    const answer = await service.explain(files, signal);
    const bitmap = await createImageBitmap(files.color, { imageOrientation: "none" });
    if (!signal.aborted) show(what, answer, bitmap);
  } catch (problem) {
    if (signal.aborted) return;
    hideResult();
    showProblem(problem, fields);
  } finally {
    if (!signal.aborted) byId("result").removeAttribute("aria-busy");
  }
}

function hideResult() {
  frame = null;
  byId("result").hidden = byId("details").hidden = true;
}

function show(what, answer, bitmap) {
  frame = answer;
  const { instances, timings } = answer;
  const named = instances.filter(({ name }) => name !== null);
  const count = `${instances.length} ${instances.length === 1 ? "object" : "objects"}`;
  const unnamed = instances.length - named.length;
  if (!instances.length) setStatus(`${what}: no objects: the label image is 0 everywhere.`);
  else setStatus(`${what}: ${count}${unnamed ? `, ${unnamed} of them unknown` : ""}.`);
  byId("result").hidden = false;
  byId("details").hidden = true;
  const colors = paints(instances);
  byId("objects").replaceChildren(...instances.map((instance, k) => element("li", {}, objectButton(instance, colors[k]))));
  const stages = Object.entries(timings).map(([stage, ms]) => `${stage}\u00a0${ms.toFixed(ms < 10 ? 1 : 0)}\u00a0ms`);
  byId("timings").textContent = stages.join(" · ");
  const first = named[0] ?? instances[0];
  overlay.show(bitmap, instances, answer.label_map, first?.label);
  if (first) select(first.label);
  if (byId("status").getBoundingClientRect().top > innerHeight / 2) byId("status").scrollIntoView();
}

function objectButton(instance, color) {
  const { label, name, confidence, classifier, occluded, unrecognized } = instance;
  const facts = name === null ? unrecognized : `${classifier.toUpperCase()} is surer${occluded ? " · partly occluded" : ""}`;
  const swatch = element("span", { className: "swatch" }, label);
  swatch.style.background = rgb(color);
  swatch.style.color = ink(color);
  const button = element(
    "button",
    { type: "button", onclick: () => select(label) },
    swatch,
    element("span", { className: "name" }, name ?? "unknown object"),
    element("span", { className: "sure" }, name === null ? "" : percent(confidence)),
    element("span", { className: "facts hint" }, facts),
  );
  button.dataset.label = label;
  return button;
}

function select(label) {
  for (const button of byId("objects").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", button.dataset.label === String(label));
  }
  overlay.select(label);
  showDetails(frame.instances.find((one) => one.label === label), loaded.model, loaded.regions);
}

async function load() {
  const [model, network] = await Promise.all([service.model(), service.colornet()]);
  byId("token-section").hidden = true;
  byId("model-title").textContent = `Objects known to the model: ${model.classes.length}`;
  byId("classes").replaceChildren(...model.classes.map((name) => element("li", {}, name)));
  byId("model").hidden = false;
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
  byId("samples").replaceChildren(...buttons);
}

function press(chosen) {
  for (const button of byId("samples").children) button.setAttribute("aria-pressed", button === chosen);
}

byId("upload-form").addEventListener("submit", (event) => {
  event.preventDefault();
  clearProblems();
  const files = Object.fromEntries(FIELDS.map((name) => [name, byId(name).files[0]]));
  const missing = FIELDS.filter((name) => !files[name]);
  if (missing.length) {
    missing.forEach((name) => markField(name, "Choose a file."));
    byId(missing[0]).focus();
    return;
  }
  press(null);
  recognize(files.color.name, async () => files, FIELDS);
});

byId("token-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  clearProblems();
  service.useToken(byId("token").value.trim());
  try {
    loaded = await load();
    setStatus("The token was accepted. Choose a frame.");
  } catch (problem) {
    showProblem(problem);
  }
});

async function watchReady() {
  const state = (name, text) => {
    byId("ready").dataset.state = name;
    byId("ready").textContent = text;
  };
  try {
    await service.ready();
    state("ready", "Ready");
  } catch (problem) {
    if (problem.status === 503) state("waiting", "Starting");
    else state("failed", "Not reachable");
    setTimeout(watchReady, 2000);
  }
}

watchReady();
showSamples().catch(showProblem);
load().then((value) => (loaded = value), showProblem);
