// The colour image with the outlines and names of its objects, and the object at a position.

import { confidenceOf, keepDrawn, percent, rgb } from "./drawing.js";
import { decoded } from "./label_image.js";

// Five colours of Okabe and Ito, as in the images of the command line, and eleven more that differ from them.
const COLORS = [
  [86, 180, 233], [240, 228, 66], [0, 158, 115], [204, 121, 167], [0, 114, 178], [170, 255, 195], [145, 30, 180],
  [220, 190, 255], [128, 128, 0], [70, 240, 240], [128, 0, 0], [255, 250, 200], [0, 0, 117], [191, 239, 69],
  [240, 50, 230], [154, 99, 36],
];
const UNKNOWN = [213, 94, 0];

const SMALL = 480; // Images narrower than this (CSS pixels) get smaller letters and thinner lines.

const MAX_COVER = 1 / 3; // Largest fraction of an object's bounding box that a tag may cover.

// Penalties of tag positions: names preferably lie beside their objects, labels on them.
const NAME_COSTS = { above: 0, below: 0.3, on: 0.6, left: 0.6, right: 0.6 };
const LABEL_COSTS = { above: 0.6, below: 0.6, on: 0, left: 0.6, right: 0.6 };

/** Return a colour for each instance. */
export function instanceColors(instances) {
  let named = 0;
  return instances.map(({ name }) => (name === null ? UNKNOWN : COLORS[named++ % COLORS.length]));
}

/** Return the text colour for a background colour. */
export const textColor = ([red, green, blue]) => (0.299 * red + 0.587 * green + 0.114 * blue > 100 ? "#000" : "#fff");

export class Overlay {
  /**
   * Draw on `canvas`; `onClick({ label, x, y })` is called with the label of the clicked object (or 0) and the clicked
   * position in pixels of the label map.
   */
  constructor(canvas, onClick) {
    Object.assign(this, { canvas, regions: null, tags: [], marked: null, takesPoints: false });
    canvas.addEventListener("click", ({ offsetX, offsetY }) => {
      if (!this.regions) return;
      const x = (offsetX * this.regions.width) / canvas.clientWidth;
      const y = (offsetY * this.regions.height) / canvas.clientHeight;
      onClick({ label: this.labelAt(offsetX, offsetY), x, y });
    });
    canvas.addEventListener("pointermove", (event) => {
      const isObject = this.labelAt(event.offsetX, event.offsetY);
      canvas.style.cursor = this.takesPoints ? "crosshair" : isObject ? "pointer" : "default";
    });
  }

  show(bitmap, instances, labelMap, selected) {
    Object.assign(this, { bitmap, instances, selected, colors: instanceColors(instances), regions: new Regions(labelMap) });
    this.canvas.style.aspectRatio = `${bitmap.width} / ${bitmap.height}`;
    const names = instances.map(({ name }) => name ?? "unknown object").join(", ");
    this.canvas.setAttribute("aria-label", `Colour image with the outlines of its objects: ${names || "none"}.`);
    this.redraw();
  }

  select(label) {
    this.selected = label;
    this.redraw();
  }

  /** Mark a position, in pixels of the label map; null marks none. */
  mark(position) {
    if (this.marked === position) return;
    this.marked = position;
    this.redraw();
  }

  redraw() {
    keepDrawn(this.canvas, (context, width, height) => this.paint(context, width, height));
  }

  /** Return the label of the object or tag at a position in CSS pixels, 0 if there is none. */
  labelAt(x, y) {
    if (!this.regions) return 0;
    const tag = this.tags.find(({ box }) => x >= box.x && x < box.x + box.width && y >= box.y && y < box.y + box.height);
    return tag ? tag.label : this.regionAt(x, y);
  }

  regionAt(x, y) {
    const { width, height } = this.regions;
    return this.regions.at(
      Math.floor((x * width) / this.canvas.clientWidth),
      Math.floor((y * height) / this.canvas.clientHeight),
    );
  }

  paint(context, width, height) {
    context.imageSmoothingQuality = "high";
    context.drawImage(this.bitmap, 0, 0, width, height);
    const across = width / this.regions.width;
    const down = height / this.regions.height;
    const toScreen = new DOMMatrix().scale(across, down);
    const onScreen = (path) => {
      const scaled = new Path2D();
      scaled.addPath(path, toScreen);
      return scaled;
    };
    context.lineCap = context.lineJoin = "round";
    const order = this.instances.map((one, k) => k).sort((a, b) => this.isSelected(a) - this.isSelected(b));
    for (const k of order) {
      const region = this.regions.of(this.instances[k].label);
      if (!region) continue;
      const outline = onScreen(region.outline);
      if (this.isSelected(k)) {
        context.fillStyle = "rgb(255 255 255 / 25%)";
        context.fill(onScreen(region.area));
      }
      const line = (this.isSelected(k) ? 4 : 2) * (width < SMALL ? 0.75 : 1);
      context.strokeStyle = "rgb(0 0 0 / 70%)";
      context.lineWidth = line + 2;
      context.stroke(outline);
      context.strokeStyle = rgb(this.colors[k]);
      context.lineWidth = line;
      context.stroke(outline);
    }
    this.placeTags(context, width, height);
    for (const tag of this.tags) this.paintTag(context, tag);
    if (this.marked) this.paintMark(context, this.marked[0] * across, this.marked[1] * down);
  }

  paintMark(context, x, y) {
    context.beginPath();
    context.arc(x, y, 5, 0, 2 * Math.PI);
    context.fillStyle = "#fff";
    context.fill();
    context.strokeStyle = "#000";
    context.lineWidth = 2;
    context.stroke();
  }

  isSelected(k) {
    return this.instances[k].label === this.selected;
  }

  /** Place the label of each object on it, then replace labels by names where there is enough space. */
  placeTags(context, width, height) {
    const small = width < SMALL;
    const size = small ? 11 : 13;
    context.font = `600 ${size}px system-ui, sans-serif`;
    this.tags = [];
    const place = (k, text, costs) => {
      const { label } = this.instances[k];
      const others = this.tags.filter((tag) => tag.label !== label);
      const padding = small ? 4 : 8;
      const room = { width: context.measureText(text).width + padding + 4, height: size + padding };
      const box = this.freePlace(label, room, others, costs, width, height);
      if (!box) return;
      this.tags = [...others, { label, text, box, color: this.colors[k], font: context.font, isSelected: this.isSelected(k) }];
    };
    this.instances.forEach(({ label }, k) => place(k, `${label}`, LABEL_COSTS));
    this.instances.forEach((instance, k) => {
      const { name } = instance;
      place(k, name === null ? "unknown" : small ? name : `\u2068${name}\u2069 ${percent(confidenceOf(instance))}`, NAME_COSTS);
    });
  }

  /** Return the box near an object that overlaps no tag and hides the least of other objects, or undefined. */
  freePlace(label, room, others, costs, width, height) {
    const region = this.regions.of(label);
    if (!region || room.width > width) return;
    const across = width / this.regions.width;
    const down = height / this.regions.height;
    const [left, right] = [region.left * across, region.right * across];
    const [top, bottom] = [region.top * down, region.bottom * down];
    const along = (low, high, share, size) => low + (high - low) * share - size / 2;
    let best = { cost: Infinity };
    for (const share of [0.5, 0.25, 0.75, 0, 1]) {
      const x = along(left, right, share, room.width);
      const y = along(top, bottom, share, room.height);
      const positions = {
        above: [x, top - room.height - 3],
        below: [x, bottom + 3],
        on: [x, along(top, bottom, 0.5, room.height)],
        left: [left - room.width - 3, y],
        right: [right + 3, y],
      };
      for (const [where, position] of Object.entries(positions)) {
        const box = {
          ...room,
          x: Math.max(0, Math.min(width - room.width, position[0])),
          y: Math.max(0, Math.min(height - room.height, position[1])),
        };
        if (others.some((other) => overlap(box, other.box)) || this.covers(box, across, down)) continue;
        const cost = 3 * this.hidden(label, box, costs.on) + costs[where] + Math.abs(share - 0.5);
        if (cost < best.cost) best = { cost, box };
      }
    }
    return best.box;
  }

  /** Return whether a box covers too much of an object. */
  covers(box, across, down) {
    return this.instances.some(({ label }) => {
      const region = this.regions.of(label);
      if (!region) return false;
      const [left, right] = [region.left * across, region.right * across];
      const [top, bottom] = [region.top * down, region.bottom * down];
      const width = Math.min(box.x + box.width, right) - Math.max(box.x, left);
      const height = Math.min(box.y + box.height, bottom) - Math.max(box.y, top);
      return width > 0 && height > 0 && width * height > MAX_COVER * (right - left) * (bottom - top);
    });
  }

  /** Return the fraction of a box that lies on objects; its own object, `label`, counts with a weight. */
  hidden(label, box, ownWeight) {
    let hits = 0;
    for (let k = 0; k < 27; k++) {
      const under = this.regionAt(box.x + (box.width * ((k % 9) + 0.5)) / 9, box.y + (box.height * (Math.floor(k / 9) + 0.5)) / 3);
      if (under !== 0) hits += under === label ? ownWeight : 1;
    }
    return hits / 27;
  }

  paintTag(context, { text, box, color, font, isSelected }) {
    context.font = font;
    context.fillStyle = rgb(color);
    context.strokeStyle = isSelected ? "#fff" : "rgb(0 0 0 / 70%)";
    context.lineWidth = isSelected ? 3 : 1;
    context.beginPath();
    context.roundRect(box.x, box.y, box.width, box.height, 4);
    context.stroke();
    context.fill();
    context.fillStyle = textColor(color);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(text, box.x + box.width / 2, box.y + box.height / 2 + 0.5);
  }
}

function overlap(a, b) {
  return a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height;
}

/** Decoded label map: area, outline and bounding box of each label, in pixels of the map. */
class Regions {
  constructor(labelMap) {
    const { width, height, labels, lengths } = labelMap;
    Object.assign(this, { width, height, map: decoded(labelMap), byLabel: new Map() });
    let start = 0;
    labels.forEach((label, k) => {
      const end = start + lengths[k];
      if (label !== 0) this.addRun(label, start, end);
      start = end;
    });
    this.trace();
  }

  at(x, y) {
    return x >= 0 && x < this.width && y >= 0 && y < this.height ? this.map[y * this.width + x] : 0;
  }

  of(label) {
    return this.byLabel.get(label);
  }

  addRun(label, start, end) {
    if (!this.byLabel.has(label)) {
      const box = { left: this.width, top: this.height, right: 0, bottom: 0 };
      this.byLabel.set(label, { area: new Path2D(), outline: new Path2D(), ...box });
    }
    const region = this.byLabel.get(label);
    while (start < end) {
      const y = Math.floor(start / this.width);
      const x = start - y * this.width;
      const length = Math.min(end - start, this.width - x);
      region.area.rect(x, y, length, 1);
      region.left = Math.min(region.left, x);
      region.right = Math.max(region.right, x + length);
      region.top = Math.min(region.top, y);
      region.bottom = Math.max(region.bottom, y + 1);
      start += length;
    }
  }

  /** Marching squares: add outline segments between each four neighbouring pixels. */
  trace() {
    for (let y = -1; y < this.height; y++) {
      for (let x = -1; x < this.width; x++) {
        const corners = [this.at(x, y), this.at(x + 1, y), this.at(x + 1, y + 1), this.at(x, y + 1)];
        if (corners.every((label) => label === corners[0])) continue;
        const middles = [[x + 1, y + 0.5], [x + 1.5, y + 1], [x + 1, y + 1.5], [x + 0.5, y + 1]];
        for (const label of new Set(corners)) {
          if (label === 0) continue;
          const crossed = middles.filter((_, k) => (corners[k] === label) !== (corners[(k + 1) % 4] === label));
          for (let k = 0; k < crossed.length; k += 2) {
            this.byLabel.get(label).outline.moveTo(...crossed[k]);
            this.byLabel.get(label).outline.lineTo(...crossed[k + 1]);
          }
        }
      }
    }
  }
}
