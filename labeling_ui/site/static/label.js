// The annotator's page: one pair on stage, the next one waiting behind it.

import { ApiError, OfflineError, request, signInAddress } from "./api.js";
import { describe, element, find, findAll, replace, toast } from "./dom.js";
import { Outbox } from "./outbox.js";
import { Player, canDraw3d } from "./player.js";
import * as notes from "./stage-notes.js";
import { Transport } from "./transport.js";
import { Watch } from "./watch.js";

const CHOICES = { left: "A is better", right: "B is better", equal: "Equal", cannot_tell: "Can’t tell" };
const SETTLE_MS = 350; // a second press of the key that judged the last pair must not judge this one
const RETRY_MS = { replays_waiting: 3000, no_pairs: 10_000, all_done: 20_000, offline: 4000 };
const MAX_HISTORY = 50;

const { campaignId, meId, uiVersion } = document.body.dataset;
const stage = find("#stage");
const outbox = new Outbox(meId);
const transport = new Transport();
const has3d = canDraw3d();

let current = null; // {handout, player | null, watch, shownAt}
let upcoming = []; // pairs of the same form that come next, first one first
const history = []; // what was judged here, the newest last: {item, key, choice}
let progress = null; // {done, remaining} as of the last answer, counted on from there
let retryTimer = null;
let turn = 0; // counts what is put on stage, so that a late answer does not push something else off

// ---- getting pairs ---------------------------------------------------------------------------

async function fetchNext(body) {
  const answer = await request("POST", `/campaigns/${campaignId}/next`, { body });
  if (answer.status === 204) return { reason: answer.headers.get("X-Reason") ?? "no_pairs" };
  return { handout: answer.data };
}

function makeReplay(handout, active) {
  if (!has3d || !handout.pair.replay_url) return { handout, player: null };
  return { handout, player: new Player(stage, handout.pair.replay_url, { view: transport.view, active }) };
}

async function showNext() {
  clearTimeout(retryTimer);
  dropExpired();
  const waiting = upcoming.shift();
  if (waiting) return show(waiting);
  transport.attach(null);
  enableChoices(false);
  const mine = (turn += 1);
  if (!notes.shown()) notes.loading("Fetching the next pair");
  try {
    await outbox.flush(); // a label on its way would make the server offer its pair again
    const { handout, reason } = await fetchNext({ hold: 1 });
    if (mine !== turn) return;
    if (handout) {
      progress = handout.progress;
      show(makeReplay(handout, true));
    } else {
      tellNothing(reason);
    }
  } catch (error) {
    if (mine === turn) tellProblem(error);
  }
}

// A pair whose lease has run out while it waited may be somebody else's by now.
function dropExpired() {
  const now = Date.now();
  const expired = (item) => !item.reopened && new Date(item.handout.expires_at).getTime() < now;
  upcoming.filter(expired).forEach((item) => item.player?.close());
  upcoming = upcoming.filter((item) => !expired(item));
}

async function prefetch() {
  const item = current;
  if (!item || upcoming.length > 0) return;
  try {
    await outbox.flush();
    if (outbox.entries.length > 0 || current !== item || upcoming.length > 0) return;
    const { handout } = await fetchNext({ hold: 2, prefetch_after_pair_id: item.handout.pair.id });
    if (!handout || current !== item || upcoming.length > 0) return;
    if (handout.pair.id !== item.handout.pair.id) upcoming.push(makeReplay(handout, false));
  } catch (error) {
    // Not being able to look ahead hurts nobody; the next step reports what is wrong.
    if (!(error instanceof OfflineError) && !(error instanceof ApiError)) throw error;
  }
}

// ---- showing a pair --------------------------------------------------------------------------

function show(item) {
  turn += 1;
  current = item;
  delete stage.dataset.nothing;
  find("#criterion").textContent = item.handout.criterion;
  stage.querySelector(".poster")?.remove();
  findAll(".choice").forEach((button) => button.classList.remove("chosen"));
  transport.onUse = (what, more) => {
    item.watch?.input();
    if (what === "seek" || what === "step" || what === "restart" || what === "view") item.watch?.record(what, more);
  };
  showProgress();
  if (!item.player) return showPoster(item);
  item.player.setActive(true);
  if (item.wired) return item.player.isReady ? begin(item) : undefined;
  item.wired = true;
  item.player.addEventListener("ready", () => { if (current === item) begin(item); });
  item.player.addEventListener("state", ({ detail }) => {
    if (current !== item) return;
    transport.show(detail);
    item.watch?.follow(detail);
  });
  item.player.addEventListener("key", ({ detail }) => { if (current === item) onKey(detail); });
  item.player.addEventListener("activity", () => item.watch?.input());
  item.player.addEventListener("failed", ({ detail }) => { if (current === item) tellFailedReplay(item, detail); });
  if (item.player.isReady) begin(item);
  else notes.loading("Loading the replay");
}

function begin(item) {
  item.watch?.close();
  item.watch = new Watch();
  notes.clear();
  transport.attach(item.player);
  if (item.player.view !== transport.view) item.player.setView(transport.view);
  transport.begin();
  item.settled = performance.now() + SETTLE_MS;
  enableChoices(true);
  stage.dataset.pairId = item.handout.pair.id;
  prefetch();
}

// Without WebGL: the moving picture of both paths.
function showPoster(item) {
  const { thumbnail_url: picture } = item.handout.pair;
  transport.attach(null);
  if (!picture) return tellFailedReplay(item, "This browser cannot draw 3D, and there is no picture.");
  notes.clear();
  const about = "Paths of run A and run B seen from above";
  stage.append(element("img.poster", { src: picture, alt: about }));
  item.watch?.close();
  item.watch = new Watch();
  item.settled = performance.now() + SETTLE_MS;
  enableChoices(true);
  stage.dataset.pairId = item.handout.pair.id;
  prefetch();
}

function enableChoices(enabled) {
  findAll(".choice").forEach((button) => { button.disabled = !enabled; });
}

function showProgress() {
  if (!progress) return;
  const total = progress.done + progress.remaining;
  const box = find("#progress");
  box.hidden = total === 0;
  find("#progress-text").textContent = `${progress.done} of ${total}`;
  find("#progress-fill").style.width = `${total ? (100 * progress.done) / total : 0}%`;
}

// ---- judging and taking back -----------------------------------------------------------------

function judge(choice) {
  const item = current;
  if (!item || find(`[data-choice="${choice}"]`).disabled || performance.now() < item.settled) return;
  find(`[data-choice="${choice}"]`).classList.add("chosen");
  enableChoices(false);
  const key = outbox.label({
    pair_id: item.handout.pair.id,
    lease_id: item.handout.lease_id,
    choice,
    client_time: new Date().toISOString(),
    ...item.watch.summary(),
    ui_version: uiVersion,
  });
  history.at(-1)?.item.player?.close();
  history.push({ item, key, choice });
  if (history.length > MAX_HISTORY) history.shift();
  if (progress) progress = { done: progress.done + 1, remaining: Math.max(0, progress.remaining - 1) };
  leave(item);
  toast(CHOICES[choice], { action: "Undo", onAction: undo });
  showNext();
}

// The replay stays behind the stage until the next answer: undo then works at once, also offline.
function leave(item) {
  setAside(item);
  stage.querySelector(".poster")?.remove();
  delete stage.dataset.pairId;
  current = null;
}

function setAside(item) {
  item.watch?.close();
  item.player?.setActive(false);
  item.player?.send("pause");
}

function undo() {
  const last = history.pop();
  if (!last) return toast("There is nothing to undo on this page.");
  outbox.undo(last.key);
  if (current) {
    setAside(current);
    enableChoices(false);
    upcoming.unshift(current);
  }
  clearTimeout(retryTimer);
  if (progress) progress = { done: Math.max(0, progress.done - 1), remaining: progress.remaining + 1 };
  const { item } = last;
  if (!item.player || item.player.closed) Object.assign(item, makeReplay(item.handout, true), { wired: false });
  show(Object.assign(item, { reopened: true }));
  toast(`Taken back: ${CHOICES[last.choice]}. Judge this pair again.`);
}

outbox.addEventListener("sent", ({ detail: { entry, answer } }) => {
  // The server has handed the pair out again, under a new lease.
  if (entry.kind === "undo" && current?.handout.pair.id === answer.next?.pair.id) {
    current.handout.lease_id = answer.next.lease_id;
  }
});

outbox.addEventListener("refused", ({ detail: { entry, error } }) => {
  const what = entry.kind === "undo" ? "The undo was not possible" : "A label was not accepted";
  toast(`${what}: ${describe(error)}`, { bad: true, seconds: 12 });
});

outbox.addEventListener("change", ({ detail: { waiting, offline, signedOut } }) => {
  const banner = find("#banner");
  banner.hidden = !(waiting > 0 && (offline || signedOut));
  if (banner.hidden) return;
  const labels = waiting === 1 ? "1 answer is" : `${waiting} answers are`;
  const text = signedOut
    ? `You are signed out. ${labels} kept on this device and will be sent after you`
    : `No connection. ${labels} kept on this device and will be sent as soon as the server answers.`;
  replace(banner, element("span", {}, text), signedOut ? element("a", { href: signInAddress() }, "sign in") : null);
});

// ---- what went wrong, or why there is nothing -------------------------------------------------

function tellNothing(reason) {
  findAll(".choice").forEach((button) => button.classList.remove("chosen"));
  if (progress && reason === "all_done") progress = { done: progress.done, remaining: 0 };
  showProgress();
  notes.nothing(reason, history.length, undo);
  stage.dataset.nothing = reason;
  retryTimer = setTimeout(showNext, RETRY_MS[reason] ?? RETRY_MS.no_pairs);
}

function tellProblem(error) {
  if (error instanceof ApiError && error.status === 401) notes.signedOut();
  else if (error instanceof OfflineError) {
    notes.offline(showNext);
    retryTimer = setTimeout(showNext, RETRY_MS.offline);
  } else notes.problem("That did not work", describe(error), showNext);
}

function tellFailedReplay(item, message) {
  notes.problem("The replay is not there", message, () => {
    item.player?.close();
    show(makeReplay(item.handout, true));
  });
}

// ---- keys and buttons ------------------------------------------------------------------------

const KEYS = {
  ArrowLeft: () => judge("left"),
  ArrowRight: () => judge("right"),
  ArrowUp: () => judge("equal"),
  ArrowDown: () => judge("cannot_tell"),
  " ": () => transport.toggle(),
  z: undo,
  Backspace: undo,
  r: () => transport.restart(),
  "[": () => transport.changeSpeed(-1),
  "]": () => transport.changeSpeed(1),
  ",": () => transport.step(-1),
  ".": () => transport.step(1),
  1: () => transport.setView("front"),
  2: () => transport.setView("top"),
  3: () => transport.setView("low"),
  "?": () => find("#help").showModal(),
};

// Returns whether the key means something here. Only frame steps may repeat while held down.
function onKey({ key, repeat }) {
  const name = key.length === 1 ? key.toLowerCase() : key;
  const action = KEYS[name];
  if (!action) return false;
  current?.watch?.input();
  if (!repeat || name === "," || name === ".") action();
  return true;
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || find("dialog[open]")) return;
  const { tagName } = event.target;
  if (tagName === "SELECT" || (event.key === " " && (tagName === "BUTTON" || tagName === "SUMMARY"))) return;
  if (event.target === transport.scrubber && event.key.startsWith("Arrow")) return;
  if (onKey(event)) event.preventDefault();
});

for (const button of findAll(".choice")) {
  button.addEventListener("click", (event) => {
    if (event.detail > 0) button.blur(); // after a mouse click the space bar is for the replay
    judge(button.dataset.choice);
  });
}
find("#help-button").addEventListener("click", () => find("#help").showModal());
for (const kind of ["pointerdown", "pointermove"]) {
  document.addEventListener(kind, () => current?.watch?.input(), { passive: true });
}
let resizeTimer = null;
window.addEventListener("resize", () => {
  clearTimeout(resizeTimer);
  resizeTimer = setTimeout(() => current?.player?.setView(transport.view), 200);
});

outbox.tell();
showNext();
