// Shows the messages of the live view; watch/live.py describes them.

const STATES = { waiting: "Waiting", live: "Live", ended: "Ended", failed: "Stopped", lost: "Disconnected" };
const SVG = "http://www.w3.org/2000/svg";

const element = (id) => document.getElementById(id);

function setState(state) {
  const ready = element("ready");
  if (ready.textContent === STATES[state]) return;
  ready.textContent = STATES[state];
  ready.dataset.state = { live: "ready", failed: "failed", lost: "failed" }[state] ?? "waiting";
}

function setText(id, text) {
  element(id).textContent = text;
}

function setOptional(id, text) {
  element(id).hidden = !text;
  element(id).textContent = text ?? "";
}

/** Returns a square of a colour; the page allows no inline styles. */
function swatch(color) {
  const svg = document.createElementNS(SVG, "svg");
  const square = document.createElementNS(SVG, "rect");
  for (const [name, value] of [["width", 14], ["height", 14], ["aria-hidden", "true"]]) svg.setAttribute(name, value);
  for (const [name, value] of [["width", 14], ["height", 14], ["fill", color]]) square.setAttribute(name, value);
  svg.append(square);
  return svg;
}

function span(name, text) {
  const made = document.createElement("span");
  made.className = name;
  made.textContent = text;
  return made;
}

/** Returns the text below the name of an object in the list. */
function note(object) {
  const parts = [];
  if (object.track !== null) parts.push(`track ${object.track}, ${object.frames} ${object.frames === 1 ? "frame" : "frames"}`);
  if (object.position) parts.push(`${object.position[2].toFixed(2)} m away`);
  if (object.occluded) parts.push("occluded");
  // The reason of an unknown object repeats the confidence, which is shown anyway.
  if (object.reason && !object.reason.startsWith("unknown")) parts.push(object.reason);
  return parts.join("; ");
}

function item(object) {
  const line = document.createElement("li");
  const confidence = object.confidence === null ? "" : `${Math.round(100 * object.confidence)} %`;
  line.append(
    swatch(object.color),
    span("name", object.name ?? "unknown"),
    span("confidence", confidence),
    span("note", note(object)),
  );
  return line;
}

function show(message) {
  setState(message.state);
  setOptional("message", message.state === "failed" ? "" : message.message);
  setOptional("problem", message.state === "failed" ? message.message : message.error);
  element("outdated").hidden = !(message.error && message.image);
  if (message.image) {
    element("picture").src = `data:image/jpeg;base64,${message.image}`;
    element("picture").hidden = false;
    element("empty").hidden = true;
  }
  if (message.number === undefined) return;
  setText("fps", message.fps ? message.fps.toFixed(1) : "–");
  setText("milliseconds", message.milliseconds ? `${Math.round(message.milliseconds)} ms` : "–");
  setText("number", message.number);
  setText("frame", message.frame.replace(/(\.\d{3})\d{6}$/, "$1")); // shortens a time stamp to milliseconds
  element("none").hidden = message.objects.length > 0;
  element("objects").replaceChildren(...message.objects.map(item));
}

const events = new EventSource("events");
events.onmessage = (event) => show(JSON.parse(event.data));
events.onerror = () => {
  // The server ends after the last message of a failed view.
  if (element("ready").textContent !== STATES.failed) setState("lost");
};
