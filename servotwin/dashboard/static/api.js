// Requests to the twin. Whatever goes wrong becomes one sentence.

export class ApiError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

const WORDS = {
  401: "The session has ended, or its token was revoked.",
  403: "This token may not read the fleet: it belongs to a machine.",
  404: "The twin has no such data.",
  429: "Too many requests at the moment.",
  503: "The twin cannot read its store now.",
};

async function detail(response) {
  try {
    return (await response.json()).detail;
  } catch {
    return "";
  }
}

export async function request(path, options = {}) {
  let response;
  try {
    response = await fetch(path, { credentials: "same-origin", signal: AbortSignal.timeout(15000), ...options });
  } catch (error) {
    throw new ApiError(error.name === "TimeoutError" ? "The twin does not answer." : "The twin cannot be reached.", 0);
  }
  if (!response.ok) {
    const said = await detail(response);
    throw new ApiError((options.detailed && said) || WORDS[response.status] || said || `The twin answers with status ${response.status}.`, response.status);
  }
  if (response.status === 204) return null;
  try {
    return await response.json();
  } catch {
    throw new ApiError("The twin's answer cannot be read.", response.status);
  }
}

export const session = () => request("/v1/session");
export const logout = () => request("/v1/session", { method: "DELETE" });
export const login = (token) =>
  request("/v1/session", { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ token }) });

// All rows, page by page, with the position from which changes are to be followed.
export async function fleet() {
  const rows = [];
  let position = null, now = Date.now() / 1000;
  for (let after = ""; ; ) {
    const page = await request(`/v1/fleet?limit=1000&after=${encodeURIComponent(after)}`);
    position ??= page.position;
    now = page.now;
    rows.push(...page.rows);
    if (page.rows.length < 1000) return { rows, position, now };
    after = page.rows.at(-1).servo;
  }
}

const servo = (name) => `/v1/servos/${encodeURIComponent(name)}`;
export const windowPath = (name, boot, sequence) => `${servo(name)}/windows/${encodeURIComponent(boot)}/${sequence}`;
export const histories = (names) => request(`/v1/fleet/histories?servos=${names.map(encodeURIComponent).join(",")}`);
export const gaps = (name, limit = 400) => request(`${servo(name)}/gaps?limit=${limit}`);
export const gapsFile = (name, kind = "csv") => `${servo(name)}/gaps.${kind}?limit=1000`;

// Saves a file that the twin may be unable to make: the reason is thrown, where a plain link would save it as the file.
export async function save(path) {
  let response;
  try {
    response = await fetch(path, { credentials: "same-origin", signal: AbortSignal.timeout(60000) });
  } catch {
    throw new ApiError("The twin cannot be reached.", 0);
  }
  if (!response.ok) throw new ApiError((await detail(response)) || WORDS[response.status] || `The twin answers with status ${response.status}.`, response.status);
  const name = response.headers.get("content-disposition")?.match(/filename="([^"]+)"/)?.[1] ?? "series";
  const url = URL.createObjectURL(await response.blob());
  const link = document.createElement("a");
  Object.assign(link, { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}
export const reportFile = (name) => `${servo(name)}/report.html`;
export const updates = (name, limit = 20) => request(`${servo(name)}/audit?updates=1&limit=${limit}`);
export const events = (name, limit = 50) => request(`${servo(name)}/events?limit=${limit}`);
export const channels = (name, boot, sequence, points, from = null, to = null) =>
  request(`${windowPath(name, boot, sequence)}/channels?points=${points}${from === null ? "" : `&from=${from}&to=${to}`}`);
export const live = (name, boot, after) => request(`${servo(name)}/live?boot=${boot}&after=${after}`);
export const residual = (name, boot, sequence) => request(`${windowPath(name, boot, sequence)}/residual`, { signal: AbortSignal.timeout(60000), detailed: true });
export const health = () => request("/healthz");
export const webhook = () => request("/v1/webhook");
export const testWebhook = () => request("/v1/webhook/test", { method: "POST", detailed: true });
export const oversight = (name) => request(`${servo(name)}/acts`);
export const act = (name, asked) =>
  request(`${servo(name)}/acts`, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(asked), detailed: true });
export const whatIf = (name, asked) =>
  request(`${servo(name)}/what-if`, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(asked), signal: AbortSignal.timeout(60000), detailed: true });
