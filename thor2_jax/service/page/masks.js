// Correction of the service's masks by clicks: pieces are dropped, merged, and split along a straight cut.

import { byId } from "./drawing.js";

const HINTS = {
  none: "Select a piece to correct its mask.",
  merge: "Choose the piece that belongs to the same object.",
  split: "Click on both ends of the cut.",
  "split again": "Click on the other end of the cut.",
  missed: "This cut does not divide the selected piece. Click on both ends of another one.",
};

export class MaskTools {
  /**
   * Correct the selected object of an overlay.
   *
   * `changed(map, selected)` is called with the corrected labels and the label of the piece to select, and `undo()` to
   * undo the last correction.
   */
  constructor(overlay, changed, undo) {
    Object.assign(this, { overlay, changed, tool: null });
    byId("drop").addEventListener("click", () => this.relabel((label) => (label === overlay.selected ? 0 : label)));
    byId("undo-mask").addEventListener("click", undo);
    for (const tool of ["merge", "split"]) {
      byId(tool).addEventListener("click", () => this.use(this.tool === tool ? null : tool));
    }
    document.addEventListener("keydown", ({ key }) => key === "Escape" && this.tool && this.use(null));
  }

  /** Show the tools for a frame that `segmenter` segmented. */
  show(segmenter, canUndo) {
    byId("masks").hidden = false;
    byId("masks-title").textContent = `Masks by the segmenter “${segmenter}”`;
    byId("undo-mask").disabled = !canUndo;
    this.use(null);
  }

  hide() {
    byId("masks").hidden = true;
    this.use(null);
  }

  use(tool, hint = tool ?? "none") {
    this.tool = tool;
    this.overlay.mark(null);
    this.overlay.takesPoints = tool === "split";
    for (const name of ["merge", "split"]) byId(name).setAttribute("aria-pressed", name === tool);
    for (const name of ["merge", "split", "drop"]) byId(name).disabled = !this.overlay.selected;
    byId("masks-hint").textContent = HINTS[hint];
  }

  /** Use a click on an object or a position for the current tool; return false if no tool is active. */
  takes({ label, x, y }) {
    if (this.tool === "merge") {
      if (label && label !== this.overlay.selected) {
        const kept = this.overlay.selected;
        this.relabel((each) => (each === label ? kept : each));
      }
    } else if (this.tool === "split" && x !== undefined) {
      if (this.overlay.marked) this.split(this.overlay.marked, [x, y]);
      else {
        this.overlay.mark([x, y]);
        byId("masks-hint").textContent = HINTS["split again"];
      }
    } else return false;
    return true;
  }

  /** Divide the selected piece along the straight line through two positions. */
  split([x0, y0], [x1, y1]) {
    const { regions, selected } = this.overlay;
    const made = 1 + regions.map.reduce((largest, label) => Math.max(largest, label), 0);
    let [left, right] = [0, 0];
    const side = (label, k) => {
      if (label !== selected) return label;
      const [x, y] = [(k % regions.width) + 0.5, Math.floor(k / regions.width) + 0.5];
      const isLeft = (x1 - x0) * (y - y0) < (y1 - y0) * (x - x0);
      isLeft ? left++ : right++;
      return isLeft ? made : label;
    };
    const map = regions.map.map(side);
    if (left && right) this.apply(map);
    else this.use("split", "missed");
  }

  relabel(change) {
    this.apply(this.overlay.regions.map.map(change));
  }

  apply(map) {
    const { selected } = this.overlay;
    this.use(null);
    this.changed(map, selected);
  }
}
