// The REST interface, and the one way in which pages hear of its errors.

export class ApiError extends Error {
  constructor(status, problem) {
    super(problem.detail || problem.title || `The server answered ${status}.`);
    this.status = status;
    this.problem = problem;
  }
}

export class OfflineError extends Error {
  constructor() {
    super("The server cannot be reached.");
  }
}

// Returns {status, headers, data}; data is null for an empty answer.
// Throws ApiError for an error answer and OfflineError when there is none.
export async function request(method, path, { body, headers = {} } = {}) {
  let answer;
  try {
    answer = await fetch(`/api/v1${path}`, {
      method,
      headers: {
        Accept: "application/json",
        ...(body === undefined ? {} : { "Content-Type": "application/json" }),
        ...headers,
      },
      body: body === undefined ? undefined : JSON.stringify(body),
      credentials: "same-origin",
    });
  } catch {
    throw new OfflineError();
  }
  const text = await answer.text();
  let data = null;
  if (text) {
    try {
      data = JSON.parse(text);
    } catch {
      data = { detail: text.slice(0, 300) };
    }
  }
  // A proxy answers 502 … 504 while the server restarts: to the page that is the same as no answer.
  if (answer.status >= 502 && answer.status <= 504) throw new OfflineError();
  if (!answer.ok) throw new ApiError(answer.status, data ?? {});
  return { status: answer.status, headers: answer.headers, data };
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
