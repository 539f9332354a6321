// The REST interface, and the one way in which pages hear of its errors.

// `ours`: the answer has the form of our server's errors; anything between it and the browser, such
// as a proxy or the sign-in page of a hotel's network, answers otherwise.
export class ApiError extends Error {
  constructor(status, problem, ours = true) {
    super(problem.detail || problem.title || `The server answered ${status}.`);
    this.status = status;
    this.problem = problem;
    this.ours = ours;
  }
}

export class OfflineError extends Error {
  constructor() {
    super("The server cannot be reached.");
  }
}

// What is to be done about an error: "signedOut", "offline", "busy" (the same will do later), or
// "final" (the server has understood, and refuses).
export function kindOf(error) {
  if (error instanceof OfflineError) return "offline";
  if (!(error instanceof ApiError)) return "busy";
  if (error.status === 401) return "signedOut";
  const later = !error.ours || error.status >= 500 || [408, 425, 429].includes(error.status);
  return later ? "busy" : "final";
}

// Returns {status, headers, data}; data is null for an empty answer.
// Throws ApiError for an error answer, and OfflineError when there is none or when it is not JSON
// and so not our server's. Says for whom the page was made: should somebody else have signed in
// since, the server answers 401.
export async function request(method, path, { body, headers = {} } = {}) {
  const { meId } = document.body.dataset;
  let answer;
  let text;
  try {
    answer = await fetch(`/api/v1${path}`, {
      method,
      headers: {
        Accept: "application/json",
        ...(meId ? { "X-Annotator-Id": meId } : {}),
        ...(body === undefined ? {} : { "Content-Type": "application/json" }),
        ...headers,
      },
      body: body === undefined ? undefined : JSON.stringify(body),
      credentials: "same-origin",
    });
    text = await answer.text(); // breaks off when the connection does
  } catch {
    throw new OfflineError();
  }
  const { status, ok } = answer;
  // A proxy answers 502 … 504 while the server restarts: to the page that is the same as no answer.
  if (status >= 502 && status <= 504) throw new OfflineError();
  const type = answer.headers.get("Content-Type") ?? "";
  const data = parse(text, type);
  if (!ok) throw new ApiError(status, data ?? {}, data !== null && type.startsWith("application/problem+json"));
  if (data === null && status !== 204) throw new OfflineError();
  return { status, headers: answer.headers, data };
}

function parse(text, type) {
  if (!/^application\/(problem\+)?json\b/.test(type)) return null;
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

export const get = async (path) => (await request("GET", path)).data;
export const post = async (path, body = {}, headers = {}) =>
  (await request("POST", path, { body, headers })).data;

export function signInAddress() {
  return `/sign-in?next=${encodeURIComponent(location.pathname + location.search)}`;
}

// A random key of 32 hex digits; randomUUID is missing where a page is not served over HTTPS.
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

// All pages of a cursor-paged list, up to `limit` rows.
export async function getAll(path, limit = 1000) {
  const rows = [];
  let cursor = null;
  do {
    const join = path.includes("?") ? "&" : "?";
    const page = await get(`${path}${join}limit=200${cursor ? `&cursor=${encodeURIComponent(cursor)}` : ""}`);
    rows.push(...(Array.isArray(page) ? page : page.items));
    cursor = Array.isArray(page) ? null : page.next_cursor;
  } while (cursor && rows.length < limit);
  return rows;
}
