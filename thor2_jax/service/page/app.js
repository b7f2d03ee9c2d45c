// Main module of the page: choose a frame, recognize it, show its objects.

import { showDetails } from "./details.js";
import { breakable, byId, confidenceOf, element, isNarrow, markField, pause, percent, rgb } from "./drawing.js";
import { decoded, labelImage } from "./label_image.js";
import { MaskTools } from "./masks.js";
import { instanceColors, Overlay, textColor } from "./overlay.js";
import * as service from "./service.js";
import { canBeNamed, connectNaming, showNaming } from "./teaching.js";
import { connectWhy, showWhy } from "./why.js";

const FIELDS = ["color", "depth", "labels", "intrinsics"];
const RETRY_MS = 1000;
const WATCH_MS = 10000; // While the service is ready.

const overlay = new Overlay(byId("overlay"), (click) => choose(click));
const maskTools = new MaskTools(overlay, changeMasks, undoMasks);
let loaded = null; // The model and the mean colours of its colour regions.
let frame = null; // The shown answer, with the arguments of `recognize` that led to it.
let currentRequest = new AbortController();

function setStatus(text, busy = false) {
  byId("status").textContent = text;
  byId("status").toggleAttribute("data-busy", busy);
  byId("status").removeAttribute("data-empty");
}

function clearProblems() {
  [...FIELDS, "token"].forEach((id) => markField(id, ""));
  byId("problem").hidden = true;
}

/** Show the errors of a request, each beside its field if the field is on the page, otherwise above the result. */
function showProblem(problem, fields = []) {
  setStatus("");
  if (problem.status === 401) {
    byId("token-section").hidden = false;
    // The first request is sent without a token, which is not an error of the user.
    if (byId("token").value) markField("token", problem.message);
    byId("token").focus();
    return;
  }
  const errors = [problem, ...(problem.further ?? [])];
  const marked = errors.filter(({ field }) => fields.includes(field));
  marked.forEach(({ field, message }) => markField(field, message));
  if (marked.length) {
    byId("upload").open = true;
    byId(marked[0].field).focus();
  }
  const others = errors.filter((error) => !marked.includes(error));
  byId("problem").textContent = others.map(({ message }) => message).join(" ");
  byId("problem").hidden = !others.length;
  if (!(problem instanceof service.Problem)) throw problem;
}

/** Call `request` again for as long as the service is starting. */
async function whenStarted(request, signal) {
  for (;;) {
    try {
      return await request();
    } catch (problem) {
      if (problem.status !== 503 || !problem.message.includes("starting") || signal.aborted) throw problem;
      setStatus(`${problem.message} The frame is recognized when it is ready.`, true);
      await pause(RETRY_MS);
    }
  }
}

/**
 * Recognize a frame and show it, with the object of label `selected()`.
 *
 * `history` has the label images before each correction of masks; null if the masks came with the frame.
 */
async function recognize(title, fileSource, fields, selected = () => null, history = null) {
  currentRequest.abort();
  const { signal } = (currentRequest = new AbortController());
  clearProblems();
  setStatus(`Recognizing ${title}`, true);
  byId("result").setAttribute("aria-busy", "true");
  try {
    loaded ??= await load();
    let files = await fileSource();
    const answer = await whenStarted(() => service.explain(files, signal), signal);
    const bitmap = await createImageBitmap(files.color, { imageOrientation: "none" });
    const { width, height } = answer.label_map;
    if (!files.labels && width === bitmap.width) {
      // All further requests have these labels, for example to enroll an object.
      files = { ...files, labels: await labelImage(decoded(answer.label_map), width, height) };
      history = [];
    }
    if (!signal.aborted) show({ ...answer, title, files, fields, history }, bitmap, selected());
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
  byId("result").hidden = true;
  byId("chooser").classList.remove("compact");
}

function show(answer, bitmap, selected) {
  frame = answer;
  const { title, instances, timings, history, knows, classes } = answer;
  Object.assign(loaded.model, { knows, classes }); // Other clients may have changed its objects.
  showClasses(loaded.model);
  const named = instances.filter(({ name }) => name !== null);
  const count = `${instances.length} ${instances.length === 1 ? "object" : "objects"}`;
  const unknown = instances.length - named.length;
  const empty = history ? "there are no masks" : "the label image is 0 everywhere";
  if (!instances.length) setStatus(`${title}: no objects: ${empty}.`);
  else setStatus(`${title}: ${count}${unknown ? `, ${unknown} of them unknown. ${unknownHint(instances)}` : "."}`);
  byId("chooser").classList.add("compact");
  byId("upload").open = false;
  byId("result").hidden = false;
  byId("details").hidden = true;
  const colors = instanceColors(instances);
  byId("objects").replaceChildren(...instances.map((instance, k) => element("li", {}, objectButton(instance, colors[k]))));
  const stages = Object.entries(timings).map(([stage, ms]) => `${stage}\u00a0${ms.toFixed(ms < 10 ? 1 : 0)}\u00a0ms`);
  byId("timings").textContent = stages.join(" · ");
  const first = instances.find(({ label }) => label === selected) ?? named[0] ?? instances[0];
  overlay.show(bitmap, instances, answer.label_map, first?.label);
  if (history) maskTools.show(loaded.model.segmenter, history.length > 0);
  else maskTools.hide();
  if (first) select(first.label);
  scrollTo({ top: 0 });
  if (byId("overlay").getBoundingClientRect().bottom > innerHeight) byId("status").scrollIntoView();
}

/** Return a description of the model's objects, and of how to enroll the others of a frame. */
function unknownHint(instances) {
  const { knows, teaches } = loaded.model;
  const how = teaches ? "Click an object to name it." : "Enroll objects by thor2 enroll, or here after thor2 serve --teach.";
  const hint = !teaches || instances.some(isInvited) ? ` ${how}` : "";
  return `This model recognizes ${knows}${knows.endsWith(".") ? "" : "."}${hint}`;
}

/** Return whether the page asks for the name of an instance. */
const isInvited = (instance) => instance.name === null && loaded.model.teaches && canBeNamed(instance);

function objectButton(instance, color) {
  const { label, name, occluded, unrecognized } = instance;
  const invites = isInvited(instance);
  const facts = invites ? "Name this object" : unrecognized ?? (occluded ? "partly occluded" : "");
  const swatch = element("span", { className: "swatch" }, label);
  swatch.style.background = rgb(color);
  swatch.style.color = textColor(color);
  const button = element(
    "button",
    {
      type: "button",
      onclick: () => {
        if (choose({ label }) && invites) byId("name").focus();
      },
    },
    swatch,
    element("span", { className: "name" }, breakable(name ?? "unknown object")),
    element("span", { className: "confidence" }, name === null ? "" : percent(confidenceOf(instance))),
    element("span", { className: invites ? "facts invitation" : "facts hint" }, facts),
  );
  button.dataset.label = label;
  return button;
}

/** Use a click on an object to correct masks or to select the object; return whether it was selected. */
function choose(click) {
  if (maskTools.takes(click) || !click.label) return false;
  // On a phone, the tapped picture stays in place, since the answer is below it.
  select(click.label, click.x === undefined || !isNarrow.matches);
  return true;
}

async function changeMasks(map, selected) {
  const { files, history, label_map } = frame;
  const labels = await labelImage(map, label_map.width, label_map.height);
  await recognizeAgain({ ...files, labels }, [...history, files.labels], () => selected);
}

function undoMasks() {
  return recognizeAgain({ ...frame.files, labels: frame.history.at(-1) }, frame.history.slice(0, -1));
}

/** Recognize the shown frame with other labels, or by a model with other objects. */
function recognizeAgain(files, history, selected = () => overlay.selected) {
  return recognize(frame.title, async () => files, frame.fields, selected, history);
}

function select(label, byUser = false) {
  for (const button of byId("objects").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", button.dataset.label === String(label));
  }
  overlay.select(label);
  const instance = frame.instances.find((one) => one.label === label);
  const { name } = instance;
  byId("answer").replaceChildren(breakable(name ?? "unknown object"), name === null ? "" : ` ${percent(confidenceOf(instance))}`);
  showDetails(instance, loaded.model, loaded.regions);
  showNaming(instance, loaded.model, frame.files);
  showWhy(instance);
  // The image stays visible while masks are corrected.
  if (byUser && !frame.history && byId("details-title").getBoundingClientRect().bottom > innerHeight) byId("details").scrollIntoView();
}

/** Load the model, and try again while the service cannot be reached. */
async function load() {
  for (;;) {
    try {
      const [model, network] = await Promise.all([service.model(), service.colornet()]);
      byId("token-section").hidden = true;
      showClasses(model);
      if (model.segmenter === null) byId("labels-hint").textContent = "PNG of instance numbers.";
      await showSamples(model);
      return { model, regions: network.mean_rgb };
    } catch (problem) {
      if (![0, 502, 503, 504].includes(problem.status)) throw problem;
      await pause(RETRY_MS);
    }
  }
}

function showClasses({ classes, knows }) {
  byId("model-title").textContent = `This model recognizes ${knows}`;
  byId("classes").replaceChildren(...classes.map((name) => element("li", {}, name)));
  byId("model").hidden = false;
}

/** Offer the sample frames whose objects are all known, or can all be enrolled. */
async function showSamples({ classes, teaches }) {
  const isKnown = (name) => teaches || classes.includes(name);
  const samples = (await service.samples()).filter(({ objects }) => objects.every(isKnown));
  const buttons = samples.map(({ folder, title }) => {
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
  byId("no-samples").hidden = samples.length > 0;
  if (!samples.length) byId("upload").open = true;
  const invitation = `${samples.length ? "Choose a sample or upload a frame" : "Upload a frame"}. Its objects are outlined and named here.`;
  if (byId("status").hasAttribute("data-empty")) byId("status").textContent = invitation;
}

function press(chosen) {
  for (const button of byId("samples").children) button.setAttribute("aria-pressed", button === chosen);
}

byId("upload-form").addEventListener("submit", (event) => {
  event.preventDefault();
  clearProblems();
  const files = Object.fromEntries(FIELDS.map((name) => [name, byId(name).files[0]]));
  const isOptional = (name) => name === "labels" && loaded?.model.segmenter !== null;
  const missing = FIELDS.filter((name) => !files[name] && !isOptional(name));
  if (!files.labels) delete files.labels;
  if (missing.length) {
    missing.forEach((name) => markField(name, "Choose a file."));
    byId(missing[0]).focus();
    return;
  }
  press(null);
  recognize(service.visible(files.color.name), async () => files, FIELDS);
});

byId("token-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  clearProblems();
  service.useToken(byId("token").value.trim());
  try {
    loaded = await load();
    byId("model-title").focus(); // The field, which had the focus, is hidden now.
    setStatus("The token was accepted. Choose a frame.");
  } catch (problem) {
    showProblem(problem);
  }
});

connectWhy(() => frame.files, showProblem);

connectNaming(async () => {
  // Another frame that is being recognized is shown next.
  if (frame && !byId("result").hasAttribute("aria-busy")) await recognizeAgain(frame.files, frame.history);
}, showProblem);

async function watchReady() {
  let again = RETRY_MS;
  const setState = (name, text) => {
    byId("ready").dataset.state = name;
    byId("ready").textContent = text;
  };
  try {
    await service.ready();
    setState("ready", "Ready");
    again = WATCH_MS;
  } catch (problem) {
    if (problem.status === 503) setState("waiting", problem.message.replace(/^The service is (.)|\.$/g, (_, c) => c?.toUpperCase() ?? ""));
    else setState("failed", "Not reachable");
  }
  setTimeout(watchReady, again);
}

/** Fold the details on a narrow screen; the user can unfold them. */
function fold() {
  for (const one of document.querySelectorAll(".fold")) one.open = !isNarrow.matches;
}

isNarrow.addEventListener("change", fold);
fold();
watchReady();
load().then((value) => (loaded = value), showProblem);
