// Naming of objects: the form in the details, and the notice with a button to undo.

import { byId, element, markField } from "./drawing.js";
import * as service from "./service.js";

/** Return whether an object can be named: known or not, its cloud must have been described. */
export const canBeNamed = ({ name, unrecognized }) => name !== null || unrecognized.startsWith("unknown");

let shown = {}; // The frame and the object of the form.
let saved = null; // The name that was saved, until the frame is recognized again.

/** Show the form for an object of a frame if the service can enroll; text typed for the same object is kept. */
export function showNaming(instance, { teaches, classes }, files) {
  if (saved !== null && shown.label === instance.label && instance.name !== saved) {
    const now = instance.name === null ? "unknown" : `“${instance.name}”`;
    byId("notice-text").textContent += ` This object is still ${now}. Add views from other sides, or forget a name that is wrong (thor2 forget).`;
    saved = null;
  }
  byId("naming").hidden = !teaches || !canBeNamed(instance);
  byId("name-label").textContent = instance.name === null ? "Name this object" : "Correct the name";
  byId("known-names").replaceChildren(...classes.map((value) => element("option", { value })));
  if (shown.files === files && shown.label === instance.label) return;
  shown = { files, label: instance.label };
  byId("name").value = "";
  markField("name", "");
}

function showNotice(text, generation = null) {
  byId("notice").hidden = false;
  byId("notice-text").textContent = text;
  byId("undo").hidden = generation === null;
  byId("undo").dataset.generation = generation;
  if (generation === null) byId("notice-text").focus(); // The button, which had the focus, is hidden now.
}

/**
 * Connect the form and the notice.
 *
 * `changed()` is called after each change, and `failed(problem)` with a problem that is not shown beside the name.
 */
export function connectNaming(changed, failed) {
  async function whileBusy(action) {
    const setBusy = (isBusy) => [byId("save-name"), byId("undo")].forEach((button) => (button.disabled = isBusy));
    setBusy(true);
    try {
      await action();
    } catch (problem) {
      failed(problem);
    } finally {
      setBusy(false);
    }
  }

  byId("naming").addEventListener("submit", (event) => {
    event.preventDefault();
    const name = byId("name").value.trim();
    markField("name", name ? "" : "Enter a name.");
    if (!name) return byId("name").focus();
    whileBusy(async () => {
      let answer;
      try {
        answer = await service.enroll(shown.files, shown.label, name);
      } catch (problem) {
        if (problem.status === 401 || !(problem instanceof service.Problem)) throw problem;
        markField("name", problem.message);
        return byId("name").focus();
      }
      byId("name").value = "";
      const { name: enrolled, views, generation } = answer;
      showNotice(views === 1 ? `“${enrolled}” is enrolled.` : `“${enrolled}” has ${views} views now.`, generation);
      byId("notice").dataset.name = enrolled;
      saved = enrolled;
      await changed();
      saved = null;
    });
  });

  byId("undo").addEventListener("click", () => {
    whileBusy(async () => {
      try {
        await service.undo(byId("undo").dataset.generation);
      } catch (problem) {
        // Only the last change can be undone.
        if (problem.status !== 409) throw problem;
        return showNotice("Another change was made since, so this one stays.");
      }
      showNotice(`The name “${byId("notice").dataset.name}” is taken back.`);
      await changed();
    });
  });
}
