// Details of one object: its cloud, its slices, and the probabilities of both classifiers.

import { element, keepDrawn, percent, rgb, themed } from "./drawing.js";

const byId = (id) => document.getElementById(id);
const TITLES = { tops: "TOPS: shape", tops2: "TOPS2: shape, colour" };

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
  byId("cloud").setAttribute("aria-label", `Point cloud of ${name}, side view, with slices from bottom to top.`);
  const { sigma_1: thickness, sigma_s: perMetre } = model.descriptor;
  byId("cloud-hint").textContent = `Aligned and cut into slices of ${+((100 * thickness) / perMetre).toFixed(1)} cm.`;
  byId("classifiers").replaceChildren(...Object.keys(instance.top).map((which) => topFive(instance, which)));
  showSlices(details, model, regions);
}

function facts({ name, label, confidence, occluded, points_used, overflow, kept_by_fallback }) {
  if (name === null) return `Label ${label}`;
  return [
    `Label ${label}`,
    `confidence ${percent(confidence)}`,
    occluded ? "partly occluded" : "not occluded",
    `${points_used} points`,
    ...(overflow ? [`overflow: ${overflow} points or pairs outside the descriptor`] : []),
    ...(kept_by_fallback ? ["outlier removal was relaxed"] : []),
  ].join(" · ");
}

function reason({ unrecognized, details }) {
  if (unrecognized !== null) return unrecognized.charAt(0).toUpperCase() + unrecognized.slice(1) + ".";
  return details === null ? "Details are limited to the first objects of a frame." : "";
}

function topFive(instance, which) {
  const rows = instance.top[which].flatMap(({ name, probability }) => {
    const bar = element("div");
    bar.style.setProperty("--share", `${100 * probability}%`);
    const cell = element("td", { colSpan: 2 }, bar);
    cell.setAttribute("aria-hidden", "true");
    return [
      element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, percent(probability))),
      element("tr", { className: "bar" }, cell),
    ];
  });
  const title = element("h3", {}, TITLES[which] ?? which.toUpperCase());
  const surer = instance.classifier === which;
  if (surer) title.append(element("span", { className: "badge" }, "surer"));
  return element("div", { className: surer ? "surer" : "" }, title, element("table", {}, element("tbody", {}, ...rows)));
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
  const drawings = slices.map(({ image, strips }, k) => {
    const points = Math.round(strips.reduce((sum, strip) => sum + total(strip), 0));
    const shape = element("canvas", { className: "image", width: image.length, height: image.length, role: "img" });
    shape.setAttribute("aria-label", `Persistence image of slice ${k}${points ? "" : ": empty"}.`);
    if (points) drawImage(shape, image);
    else shape.classList.add("empty");
    const colors = element("canvas", { className: "strips", role: "img" });
    const where = `${points} points in ${strips.length} strips, most of ${mainColor(strips, regions)}`;
    colors.setAttribute("aria-label", `Colour of slice ${k}: ${points ? where : "empty"}.`);
    const count = model.descriptor.convention === "released" ? `${strips.length} strips` : `${points} points`;
    const title = element("header", {}, element("h4", {}, `Slice ${k}`), element("p", { className: "hint" }, points ? count : "empty"));
    const item = element("li", {}, title, shape, colors);
    return { item, colors, strips };
  });
  byId("slices").replaceChildren(...drawings.map(({ item }) => item));
  for (const { colors, strips } of drawings) {
    keepDrawn(colors, (context, width, height) => {
      // An image starts one pixel before the first strip; with this offset, strips lie below their births.
      const step = width / Math.max(model.descriptor.image_size, model.descriptor.n_strips + 1);
      for (const { strip, regions: present, weights } of strips) {
        let y = height;
        present.forEach((region, k) => {
          const tall = (weights[k] / highest) * (height - 4);
          y -= tall;
          context.fillStyle = rgb(regions[region]);
          context.fillRect((strip + 1) * step, y, step, tall);
        });
      }
    });
  }
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

function drawImage(canvas, image) {
  const size = image.length;
  const context = canvas.getContext("2d");
  const pixels = context.createImageData(size, size);
  image.forEach((column, birth) =>
    column.forEach((value, persistence) => {
      const place = (value / 255) * (MAGMA.length - 1);
      const below = Math.min(Math.floor(place), MAGMA.length - 2);
      const color = MAGMA[below].map((low, k) => low + (MAGMA[below + 1][k] - low) * (place - below));
      pixels.data.set([...color, 255], 4 * ((size - 1 - persistence) * size + birth));
    }),
  );
  context.putImageData(pixels, 0, 0);
}
