// Requests to the service. Every error is a Problem, whose message can be shown to the user.

let token = "";

export class Problem extends Error {
  constructor(status, field, message) {
    super(message);
    this.status = status;
    this.field = field;
  }
}

export function useToken(value) {
  token = value;
}

async function call(path, options = {}) {
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  let answer;
  try {
    answer = await fetch(path, { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, null, "The service cannot be reached. It may be down, or the files may be too large.");
  }
  if (answer.ok) return answer;
  const { field = null, message = `The service answered with status ${answer.status}.` } = await answer
    .json()
    .catch(() => ({}));
  const again = answer.headers.has("Retry-After") ? " Try again in a moment." : "";
  throw new Problem(answer.status, field, message + again);
}

const json = async (path, options) => (await call(path, options)).json();

export const ready = () => call("readyz");
export const model = () => json("v1/model");
export const colornet = () => json("v1/colornet");
export const samples = () => json("samples/index.json");

export async function sampleFiles(folder) {
  const names = { color: "color.jpg", depth: "depth.png", labels: "labels.png", intrinsics: "intrinsics.json" };
  const load = async ([part, name]) => [part, await (await call(`samples/${folder}/${name}`)).blob()];
  return Object.fromEntries(await Promise.all(Object.entries(names).map(load)));
}

export function explain(files, signal) {
  const body = new FormData();
  for (const [part, file] of Object.entries(files)) body.append(part, file);
  return json("v1/explain", { method: "POST", body, signal });
}
