// Whether somebody works on what waits: a campaign page would say "queued" for ever where no worker
// runs, and only the system's own report knows why.

import { element, find } from "./dom.js";
import { ago } from "./format.js";
import { renew } from "./steady.js";

const CHECK_MS = 15_000;
const MOMENT = /at (\d{4}-\d\d-\d\dT[\d:.]+\+00:00)/g; // the report's times, in UTC
let checked = -Infinity;

// `jobs` counts the open ones: with none open nobody needs a worker. Asks at most every CHECK_MS.
export async function watchSystem(jobs, now = performance.now()) {
  if (jobs.queued + jobs.running === 0) find("#system").hidden = true;
  if (jobs.queued + jobs.running === 0 || now - checked < CHECK_MS) return;
  checked = now;
  let missing;
  try {
    const answer = await fetch("/api/v1/ready"); // 503 with the same report where a part is missing
    const { checks } = await answer.json();
    missing = Object.values(checks).filter((report) => report !== "ok");
  } catch {
    return; // no answer, or a proxy's: the page tells that by itself
  }
  const told = missing.join("; ").replaceAll(MOMENT, (_, moment) => ago(moment));
  renew(find("#system"), element("span", {}, element("strong", {}, "Work is waiting, and a part of the system does not answer: "), told));
  find("#system").hidden = missing.length === 0;
}
