// Requests to the service. Every error is a Problem, whose message can be shown to the user.

let token = "";

export class Problem extends Error {
  constructor(status, field, message, further = []) {
    super(message);
    Object.assign(this, { status, field, further });
  }
}

export function useToken(value) {
  token = value.replace(/[^\x20-\x7e]/g, "?"); // A header that has other characters is not sent.
}

/** Escape control characters and characters that change the direction of text. */
export function visible(text) {
  return text.replace(/[\u0000-\u001f\u007f-\u009f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]/g, (character) => {
    return `\\u${character.charCodeAt(0).toString(16).padStart(4, "0")}`;
  });
}

async function call(path, options = {}) {
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  let response;
  try {
    response = await fetch(path, { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, null, "The service cannot be reached. It may be down, or the files may be too large.");
  }
  if (response.ok) return response;
  const { field = null, message = `The service answered with status ${response.status}.`, further } = await parse(
    response,
  ).catch(() => ({}));
  const again = response.status === 429 ? " Try again in a moment." : "";
  const problem = new Problem(response.status, field, message + again, further);
  problem.retryAfter = Number(response.headers.get("Retry-After") ?? 1);
  throw problem;
}

const parse = async (response) =>
  JSON.parse(await response.text(), (_, value) => (typeof value === "string" ? visible(value) : value));
const json = async (path, options) => parse(await call(path, options));

export const ready = () => call("readyz");
export const model = () => json("v1/model");
export const colornet = () => json("v1/colornet");
export const samples = () => json("samples/index.json");

export async function sampleFiles(folder) {
  const names = { color: "color.jpg", depth: "depth.png", labels: "labels.png", intrinsics: "intrinsics.json" };
  const load = async ([part, name]) => [part, await (await call(`samples/${folder}/${name}`)).blob()];
  return Object.fromEntries(await Promise.all(Object.entries(names).map(load)));
}

function form(parts) {
  const body = new FormData();
  for (const [part, value] of Object.entries(parts)) body.append(part, value);
  return body;
}

export const explain = (files, signal) => json("v1/explain", { method: "POST", body: form(files), signal });

/** Explain the answer for one object of a frame. */
export const why = (files, instance, signal) => json("v1/why", { method: "POST", body: form({ ...files, instance }), signal });

/** Enroll one object of a frame; an existing object gets a further view. */
export const enroll = (files, instance, name) =>
  json("v1/objects", { method: "POST", body: form({ ...files, instance, name, extend: "true" }) });

export const undo = (generation) => json("v1/objects/undo", { method: "POST", body: form({ generation }) });
