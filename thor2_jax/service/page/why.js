// Explanation of one object: the pictures of /v1/why.

import { byId, element, isNarrow, pause } from "./drawing.js";
import * as service from "./service.js";

let request = new AbortController();

/** Show the button for an object, without the explanation of another object. */
export function showWhy({ label, details }) {
  request.abort();
  byId("why").hidden = details === null;
  byId("ask-why").disabled = false;
  byId("ask-why").dataset.label = label;
  byId("why-status").textContent = "";
  byId("why-pictures").replaceChildren();
}

async function pictureOf({ title, caption, png }, number) {
  const bytes = Uint8Array.from(atob(png), (character) => character.charCodeAt(0));
  const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
  const canvas = element("canvas", { width: bitmap.width, height: bitmap.height, role: "img" });
  canvas.setAttribute("aria-label", `${title}. ${caption}`);
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  const open = number === 0 || !isNarrow.matches;
  const text = element("p", { className: "hint" }, caption);
  return element("details", { className: "fold", open }, element("summary", {}, element("h4", {}, title)), text, canvas);
}

function summary({ name, explained_name, unit, margin, changes, ...answer }) {
  const digits = unit === "log-odds" ? 1 : 2;
  const value = (Number(margin.toFixed(digits)) + 0).toFixed(digits); // not -0.00
  const [worst, random] = [answer.loss_without_most_attributed_tenth, answer.mean_loss_without_random_tenth];
  const what = unit === "log-odds" ? "Log-odds (0 is even, 4.6 means 99\u00a0%)" : "Lead in similarity over other objects";
  const subject = name === null ? `Most probable, though unknown: ${explained_name}. ` : "";
  const found = changes.length
    ? `Smallest changes that make another name most probable: ${changes.join("; ")}.`
    : "No change of colour or side lengths was found that makes another name most probable.";
  const change = (loss) => `${loss < -0.005 ? "rises" : "falls"} by ${Math.abs(loss).toFixed(2)}`;
  const fall = `Without the tenth of the points that speaks most for the name, it ${change(worst)}; without a random tenth, it ${change(random)}.`;
  return `${subject}${what}: ${value}. ${fall} ${found}`;
}

/** Return the response of /v1/why; while the service compiles explanations, show this and repeat the request. */
async function explanation(files, label, signal) {
  for (;;) {
    try {
      return await service.why(files, label, signal);
    } catch (problem) {
      if (problem.status !== 503) throw problem;
      byId("why-status").textContent = `${problem.message} The answer appears here then.`;
      await pause(1000 * problem.retryAfter);
      signal.throwIfAborted();
    }
  }
}

/** Connect the button. `shownFiles()` returns the files of the frame, `failed(problem)` shows other problems. */
export function connectWhy(shownFiles, failed) {
  byId("ask-why").addEventListener("click", async () => {
    const { signal } = (request = new AbortController());
    byId("ask-why").disabled = true;
    byId("why-status").textContent = "Computing what decided.";
    try {
      const answer = await explanation(shownFiles(), byId("ask-why").dataset.label, signal);
      const figures = await Promise.all(answer.pictures.map(pictureOf));
      if (signal.aborted) return;
      byId("why-status").textContent = summary(answer);
      byId("why-pictures").replaceChildren(...figures);
    } catch (problem) {
      if (signal.aborted) return;
      byId("why-status").textContent = "";
      if (problem.status === 401 || !(problem instanceof service.Problem)) return failed(problem);
      byId("why-status").textContent = problem.message;
    } finally {
      if (!signal.aborted) byId("ask-why").disabled = false;
    }
  });
}
