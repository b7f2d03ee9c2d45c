// Details of one object: its cloud, its slices, and the probabilities of each classifier.

import { breakable, byId, element, keepDrawn, percent, rgb, themed } from "./drawing.js";

const TITLES = {
  tops: "TOPS: shape",
  tops2: "TOPS2: shape and colour",
  embedding: "Embedding: shape and colour",
  gallery: "Gallery: enrolled views",
};

/** Fill the section. `regions` are the mean colours of the colour regions. */
export function showDetails(instance, model, regions) {
  const { name, label, details } = instance;
  byId("details-title").textContent = name ?? `Object ${label}: unknown`;
  byId("details-facts").textContent = facts(instance);
  byId("details-reason").textContent = reason(instance);
  byId("evidence").hidden = details === null;
  byId("details").hidden = false;
  if (details === null) return;
  keepDrawn(byId("cloud"), (context, width, height) => drawCloud(context, width, height, instance));
  byId("cloud").setAttribute("aria-label", `Point cloud of ${name ?? "the object"}, side view, with slices from bottom to top.`);
  const { sigma_1: thickness, sigma_s: perMetre } = model.descriptor;
  byId("cloud-hint").textContent = `Aligned and cut into slices of ${+((100 * thickness) / perMetre).toFixed(1)} cm.`;
  const sources = Object.keys(instance.top).filter((source) => instance.top[source].length);
  byId("classifiers").replaceChildren(...sources.map((source) => topFive(instance, source, sources.length > 1)));
  byId("confidence-help").textContent = confidenceHelp(details.calibrated_confidence, sources);
  showSlices(details, model, regions);
}

function facts({ label, confidence, occluded, points_used, overflow, kept_by_fallback, details }) {
  if (confidence === null) return `Label ${label}`;
  const calibrated = details?.calibrated_confidence ?? null;
  return [
    `Label ${label}`,
    `confidence ${percent(confidence)} (${calibration(confidence, calibrated)})`,
    occluded ? "partly occluded" : "not occluded",
    `${points_used} points`,
    ...(overflow ? [`overflow: ${overflow} points or pairs outside the descriptor`] : []),
    ...(kept_by_fallback ? ["outlier removal was relaxed"] : []),
  ].join(" · ");
}

function calibration(confidence, calibrated) {
  if (calibrated === null) return "not calibrated";
  return percent(calibrated) === percent(confidence) ? "calibrated" : `calibrated: ${percent(calibrated)}`;
}

function confidenceHelp(calibrated, sources) {
  if (!sources.length) return "No object is enrolled.";
  const gallery = "The score of the gallery is about 1 among the enrolled views of an object and about 0 far from all of them. ";
  if (sources.length === 1 && sources[0] === "gallery") return `${gallery}The confidence rises with it and is 50 % at a score of 0.2; it is not calibrated.`;
  const both = "An enrolled object is the answer if its score is high: the more likely a trained class is, the higher the score must be. A trained class that is the answer keeps its confidence. ";
  if (sources.includes("gallery")) return `${gallery}${both}The confidence is not calibrated.`;
  const fusion = "The named class has the highest geometric mean of both probabilities; normalized, it is the confidence. ";
  const known = "The embedding separates the classes from other objects: the less likely it finds all of them together, the lower is the confidence. For known objects, it estimates the probability that the name is correct.";
  const alone = sources.length === 1;
  if (sources.includes("embedding") && (!alone || calibrated !== null)) {
    return `The named class has the highest ${alone ? "probability" : "geometric mean of the other probabilities"}. ${known}`;
  }
  if (alone) return "The named class has the highest probability; divided by that of all classes, it is the confidence. It is not calibrated.";
  if (calibrated !== null) return `${fusion}The calibrated confidence (temperature scaling on a held-out set) estimates the accuracy of such answers.`;
  return `${fusion}It is not calibrated, since the model was trained without a held-out set: expect fewer correct answers than it suggests.`;
}

function reason({ unrecognized, details }) {
  if (unrecognized !== null) return unrecognized.charAt(0).toUpperCase() + unrecognized.slice(1) + ".";
  return details === null ? "Details are limited to the first objects of a frame." : "";
}

function topFive(instance, classifier, isCompared) {
  const rows = instance.top[classifier].flatMap(({ name, probability }) => {
    const bar = element("div");
    bar.style.setProperty("--share", `${100 * probability}%`);
    const cell = element("td", { colSpan: 2 }, bar);
    cell.setAttribute("aria-hidden", "true");
    return [
      element("tr", {}, element("th", { scope: "row" }, breakable(name)), element("td", {}, percent(probability))),
      element("tr", { className: "bar" }, cell),
    ];
  });
  const title = element("h3", {}, TITLES[classifier] ?? classifier.toUpperCase());
  const isHigher = isCompared && instance.classifier === classifier;
  if (isHigher) title.append(element("span", { className: "badge" }, "higher probability"));
  return element("div", { className: isHigher ? "higher" : "" }, title, element("table", {}, element("tbody", {}, ...rows)));
}

function drawCloud(context, width, height, { details, points_used }) {
  const { points, colors, slice_borders: borders } = details;
  const top = Math.max(...points.map(([, , z]) => z), 1e-6);
  const used = borders.filter(([low]) => low < top);
  const right = Math.max(...points.map(([x]) => x), 1e-6);
  const roof = Math.max(top, used.at(-1)[1]);
  const margin = 24;
  const scale = Math.min((width - margin - 2) / right, (height - 4) / roof);
  const left = margin + (width - margin - right * scale) / 2;
  const toX = (x) => left + x * scale;
  const toY = (z) => (height + (roof - Math.min(0, borders[0][0])) * scale) / 2 - z * scale;

  context.font = "12px system-ui, sans-serif";
  context.textBaseline = "middle";
  used.forEach(([low, high], k) => {
    context.fillStyle = themed(k % 2 ? "--card" : "--well");
    context.fillRect(margin, toY(high), width - margin, (high - low) * scale);
    context.fillStyle = themed("--muted");
    context.fillText(k, 6, toY((low + high) / 2));
  });
  // A sample of a large cloud is drawn with larger dots, so that surfaces look closed.
  const radius = Math.max(1.2, 0.007 * scale * Math.sqrt(points_used / points.length));
  const backToFront = points.map((_, k) => k).sort((a, b) => points[b][1] - points[a][1]);
  for (const k of backToFront) {
    context.fillStyle = rgb(colors[k]);
    context.beginPath();
    context.arc(toX(points[k][0]), toY(points[k][2]), radius, 0, 2 * Math.PI);
    context.fill();
  }
  context.fillStyle = themed("--edge");
  for (const [low, high] of used) {
    context.fillRect(margin, toY(low), width - margin, 1);
    context.fillRect(margin, toY(high), width - margin, 1);
  }
}

function showSlices({ slices }, model, regions) {
  const total = ({ weights }) => weights.reduce((sum, weight) => sum + weight, 0);
  const highest = Math.max(...slices.flatMap(({ strips }) => strips.map(total)), 1e-6);
  const drawings = slices.flatMap(({ image, strips }, k) => {
    if (!strips.length) return [];
    const points = Math.round(strips.reduce((sum, strip) => sum + total(strip), 0));
    const shape = element("canvas", { className: "image", role: "img" });
    shape.setAttribute("aria-label", `Persistence image of slice ${k}: birth to the right, persistence upwards.`);
    const colors = element("canvas", { className: "strips", role: "img" });
    const content = `${points} points in ${strips.length} strips, most of ${mainColor(strips, regions)}`;
    colors.setAttribute("aria-label", `Colour of slice ${k}: ${content}.`);
    const count = model.descriptor.convention === "released" ? `${strips.length} strips` : `${points} points`;
    const title = element("header", {}, element("h4", {}, `Slice ${k}`), element("p", { className: "hint" }, count));
    return [{ item: element("li", {}, title, shape, colors), shape, colors, image, strips }];
  });
  byId("slices").replaceChildren(...drawings.map(({ item }) => item));
  const empty = slices.flatMap(({ strips }, k) => (strips.length ? [] : [k]));
  byId("empty-slices").textContent = empty.length ? `Without points: ${empty.length > 1 ? "slices" : "slice"} ${empty.join(", ")}.` : "";
  for (const { shape, colors, image, strips } of drawings) {
    const pixels = imagePixels(image);
    keepDrawn(shape, (context, width, height) => {
      const plot = drawAxes(context, width, height, model.descriptor, "persistence");
      context.imageSmoothingEnabled = false;
      context.drawImage(pixels, plot.left, plot.top, plot.width, plot.height);
    });
    keepDrawn(colors, (context, width, height) => {
      const plot = drawAxes(context, width, height, model.descriptor, "points", Math.ceil(highest));
      const step = plot.width / model.descriptor.image_size;
      for (const { strip, regions: present, weights } of strips) {
        let y = plot.top + plot.height;
        present.forEach((region, k) => {
          const tall = (weights[k] / highest) * plot.height;
          y -= tall;
          context.fillStyle = rgb(regions[region]);
          // An image starts one pixel before the first strip; with this offset, strips lie below their births.
          context.fillRect(plot.left + (strip + 1) * step, y, step, tall);
        });
      }
    });
  }
}

/** Draw the axes of a chart whose horizontal axis is the birth, and return the area inside. */
function drawAxes(context, width, height, { image_size, sigma_2: pixel, sigma_s: perMetre }, vertical, peak) {
  const plot = { left: 26, top: 5, width: width - 32, height: height - 32 };
  const perPixel = (100 * pixel) / perMetre; // Centimetres; an image starts one pixel before 0.
  const last = (image_size - 1) * perPixel;
  const ticks = [0, 10, 20, 30].filter((value) => value <= last);
  context.fillStyle = themed("--well");
  context.fillRect(plot.left, plot.top, plot.width, plot.height);
  context.strokeStyle = context.fillStyle = themed("--muted");
  context.font = "10px system-ui, sans-serif";
  context.textBaseline = "middle";
  const line = (x, y, dx, dy) => {
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + dx, y + dy);
    context.stroke();
  };
  const bottom = plot.top + plot.height;
  line(plot.left - 0.5, plot.top, 0, plot.height);
  line(plot.left, bottom + 0.5, plot.width, 0);
  const share = (value) => (value / perPixel + 1) / image_size;
  const isEnd = (value) => value === 0 || value === ticks.at(-1);
  for (const value of ticks) {
    const x = plot.left + share(value) * plot.width;
    line(x, bottom, 0, 3);
    context.textAlign = "center";
    if (isEnd(value)) context.fillText(value, x, bottom + 9);
  }
  context.textAlign = "right";
  const heights = peak === undefined ? ticks.map((value) => [value, share(value)]) : [[0, 0], [peak, 1]];
  for (const [value, place] of heights) {
    const y = bottom - place * plot.height;
    line(plot.left, y, -3, 0);
    if (peak !== undefined || isEnd(value)) context.fillText(value, plot.left - 5, Math.min(y, bottom - 2));
  }
  context.textAlign = "center";
  context.fillText("birth (cm)", plot.left + plot.width / 2, bottom + 20);
  context.save();
  context.translate(7, plot.top + plot.height / 2);
  context.rotate(-Math.PI / 2);
  context.fillText(peak === undefined ? `${vertical} (cm)` : vertical, 0, 0);
  context.restore();
  return plot;
}

function mainColor(strips, regions) {
  const sums = new Map();
  for (const { regions: present, weights } of strips) {
    present.forEach((region, k) => sums.set(region, (sums.get(region) ?? 0) + weights[k]));
  }
  const [region] = [...sums].sort((a, b) => b[1] - a[1])[0] ?? [0];
  return `colour ${regions[region].map(Math.round).join(", ")}`;
}

// Nine colours of matplotlib's magma colour map.
const MAGMA = [
  [0, 0, 4], [28, 16, 68], [79, 18, 123], [129, 37, 129], [181, 54, 122], [229, 80, 100], [251, 135, 97],
  [254, 194, 135], [252, 253, 191],
];

function imagePixels(image) {
  const size = image.length;
  const canvas = element("canvas", { width: size, height: size });
  const context = canvas.getContext("2d");
  const pixels = context.createImageData(size, size);
  image.forEach((column, birth) =>
    column.forEach((value, persistence) => {
      const position = (value / 255) * (MAGMA.length - 1);
      const below = Math.min(Math.floor(position), MAGMA.length - 2);
      const color = MAGMA[below].map((low, k) => low + (MAGMA[below + 1][k] - low) * (position - below));
      pixels.data.set([...color, 255], 4 * ((size - 1 - persistence) * size + birth));
    }),
  );
  context.putImageData(pixels, 0, 0);
  return canvas;
}
