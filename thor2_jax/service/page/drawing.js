// Helpers that the modules share: elements, texts, colours, and canvases at the resolution of the screen.

const drawn = new WeakMap();
const watch = new ResizeObserver((entries) => {
  for (const { target } of entries) {
    if (target.isConnected) draw(target);
    else watch.unobserve(target);
  }
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  [...document.querySelectorAll("canvas")].filter((canvas) => drawn.has(canvas)).forEach(draw);
});

function draw(canvas) {
  const scale = devicePixelRatio;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width || !height) return;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const context = canvas.getContext("2d");
  context.scale(scale, scale);
  drawn.get(canvas)(context, width, height);
}

/** Draw with `paint(context, width, height)` in CSS pixels, now and after every change of size or colour scheme. */
export function keepDrawn(canvas, paint) {
  drawn.set(canvas, paint);
  watch.observe(canvas);
  draw(canvas);
}

/** Whether the page is as narrow as on a phone, where details are folded. */
export const isNarrow = matchMedia("(max-width: 48rem)");

/** Return a colour of the style sheet, for example `--muted`. */
export const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export const rgb = ([red, green, blue]) => `rgb(${red} ${green} ${blue})`;

/** Format a probability; instead of 0 % and 100 %, the result is "<0.1 %" and ">99.9 %". */
export function percent(probability) {
  if (probability >= 0.9995) return ">99.9\u00a0%";
  if (probability < 0.0005) return "<0.1\u00a0%";
  const digits = probability >= 0.995 || probability < 0.0995 ? 1 : 0;
  return `${(100 * probability).toFixed(digits)}\u00a0%`;
}

/** Return the calibrated confidence of an instance if it has one. */
export const confidenceOf = ({ confidence, details }) => details?.calibrated_confidence ?? confidence;

/** Split a name at its underscores, so that a line can break there; Arabic names do not move the text beside them. */
export const breakable = (name) => element("bdi", {}, ...name.split(/(?<=_)/).flatMap((piece) => [piece, element("wbr")]));

export const byId = (id) => document.getElementById(id);

/** Show an error beside a field; an empty message removes it. */
export function markField(id, message) {
  byId(`${id}-error`).textContent = message;
  if (message) byId(id).setAttribute("aria-invalid", "true");
  else byId(id).removeAttribute("aria-invalid");
}

export const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

/** Create an element with properties and children. */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}
