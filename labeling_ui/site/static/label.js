// The annotator's page: one pair on stage, the next one waiting behind it.

import { ApiError, OfflineError, kindOf } from "./api.js";
import { describe, element, enable, find, findAll, toast } from "./dom.js";
import { CHOICES } from "./format.js";
import { listenToKeys } from "./keys.js";
import { Outbox } from "./outbox.js";
import { showOutbox } from "./outbox-notes.js";
import { Player, canDraw3d } from "./player.js";
import * as notes from "./stage-notes.js";
import { Supply } from "./supply.js";
import { Transport } from "./transport.js";
import { Watch } from "./watch.js";

const SETTLE_MS = 350; // a second press of the key that judged the last pair must not judge this one
const RETRY_MS = { replays_waiting: 3000, no_pairs: 10_000, all_done: 20_000, offline: 4000, busy: 8000 };
const MAX_HISTORY = 50;

const { campaignId, meId, uiVersion } = document.body.dataset;
const stage = find("#stage");
const outbox = new Outbox(meId);
const supply = new Supply(campaignId, outbox, prepare);
const transport = new Transport();
const has3d = canDraw3d();

let current = null; // {handout, player | null, watch, shownAt}
const history = []; // what was judged here, the newest last: {item, key, choice}
let progress = null; // {done, remaining} as of the last answer, counted on from there
let retryTimer = null;
let turn = 0; // counts what is put on stage, so that a late answer does not push something else off

function prepare(handout, active) {
  if (!has3d || !handout.pair.replay_url) return { handout, player: null };
  const how = { view: transport.view, active, stepS: handout.pair.step_s };
  return { handout, player: new Player(stage, handout.pair.replay_url, how) };
}

// ---- showing a pair --------------------------------------------------------------------------

async function showNext() {
  clearTimeout(retryTimer);
  const waiting = supply.take();
  if (waiting) return show(waiting);
  transport.attach(null);
  enableChoices(false);
  const mine = (turn += 1);
  if (!notes.shown()) notes.loading("Fetching the next pair");
  try {
    const { item, reason } = await supply.next();
    if (mine !== turn) return item?.player?.close();
    if (!item) return tellNothing(reason);
    progress = item.handout.progress;
    show(item);
  } catch (error) {
    if (mine === turn) tellProblem(error);
  }
}

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
  if (item.player.closed || item.player.failure) renew(item);
  item.player.setActive(true);
  wire(item);
  if (item.player.isReady) begin(item);
  else notes.loading("Loading the replay");
}

// Another try for a replay that was put away, or that failed while it waited.
function renew(item) {
  item.player.close();
  Object.assign(item, prepare(item.handout, true), { wired: false });
}

function wire(item) {
  if (item.wired) return;
  item.wired = true;
  const whenShown = (name, action) =>
    item.player.addEventListener(name, ({ detail }) => { if (current === item) action(detail); });
  whenShown("ready", () => begin(item));
  whenShown("state", (state) => {
    transport.show(state);
    item.watch?.follow(state);
  });
  whenShown("key", pressedInScene);
  whenShown("activity", () => {
    item.watch?.input();
    find(".menu").open = false; // a click in the scene is a click outside the menu
  });
  whenShown("failed", (failure) => tellFailedReplay(item, failure));
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
  supply.lookAhead(item, () => current === item);
}

// Without WebGL: the moving picture of both paths.
function showPoster(item) {
  const { thumbnail_url: picture } = item.handout.pair;
  transport.attach(null);
  if (!picture) return tellFailedReplay(item, { message: "This browser cannot draw 3D, and there is no picture." });
  notes.clear();
  const about = "Paths of run A and run B seen from above";
  stage.append(element("img.poster", { src: picture, alt: about }));
  item.watch?.close();
  item.watch = new Watch();
  item.settled = performance.now() + SETTLE_MS;
  enableChoices(true);
  stage.dataset.pairId = item.handout.pair.id;
  supply.lookAhead(item, () => current === item);
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
  showUndo();
  if (progress) progress = { done: progress.done + 1, remaining: Math.max(0, progress.remaining - 1) };
  showProgress(); // at once: without a connection there is no next pair that would show it
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
  showUndo();
  if (!last) return toast("There is nothing to undo on this page.");
  outbox.undo(last.key);
  if (current) {
    setAside(current);
    enableChoices(false);
    supply.putFirst(current);
  }
  clearTimeout(retryTimer);
  if (progress) progress = { done: Math.max(0, progress.done - 1), remaining: progress.remaining + 1 };
  show(Object.assign(last.item, { reopened: true }));
  toast(`Taken back: ${CHOICES[last.choice]}. Judge this pair again.`);
}

function showUndo() {
  find("#undo").disabled = history.length === 0;
}

outbox.addEventListener("sent", ({ detail: { entry, answer } }) => {
  // The server has handed the pair out again, under a new lease.
  if (entry.kind === "undo" && answer.next && current?.handout.pair.id === answer.next.pair.id) {
    current.handout.lease_id = answer.next.lease_id;
  }
});

// Without a label: the pair goes to others, and the admins hear why.
async function skip(item, reason) {
  leave(item);
  item.player?.close();
  const mine = (turn += 1);
  notes.loading("Giving the pair back");
  try {
    await supply.release(item, reason);
    if (progress) progress = { ...progress, remaining: Math.max(0, progress.remaining - 1) };
    if (mine === turn) showNext();
  } catch (error) {
    if (mine === turn) tellProblem(error);
  }
}

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
  const known = error instanceof ApiError || error instanceof OfflineError;
  const kind = known ? kindOf(error) : "final";
  if (kind === "signedOut") return tellSignedOut();
  if (kind === "final") return notes.problem("That did not work", describe(error), showNext);
  if (kind === "offline") notes.offline(showNext);
  else notes.busy(describe(error), showNext);
  retryTimer = setTimeout(showNext, RETRY_MS[kind]);
}

// Whoever signs in again in another tab and comes back finds the page at work.
function tellSignedOut(retry = showNext) {
  notes.signedOut();
  const mine = turn;
  const comeBack = () => {
    if (document.visibilityState !== "visible") return;
    document.removeEventListener("visibilitychange", comeBack);
    if (mine === turn) retry();
  };
  document.addEventListener("visibilitychange", comeBack);
}

function tellFailedReplay(item, { message, status }) {
  if (status === 401) return tellSignedOut(() => show(item));
  const broken = item.player !== null;
  notes.failedReplay(message, {
    retry: () => show(item),
    skipLabel: broken ? "Skip and report" : "Skip",
    skip: () => skip(item, broken ? "replay_failed" : "skipped"),
  });
}

// ---- keys and buttons ------------------------------------------------------------------------

const openHelp = () => find("#help").showModal();
const ACTIONS = {
  ...Object.fromEntries(Object.keys(CHOICES).map((choice) => [choice, () => judge(choice)])),
  undo,
  ...transport.commands,
  help: openHelp,
};
const pressedInScene = listenToKeys((command) => {
  current?.watch?.input();
  ACTIONS[command]();
});

for (const button of findAll(".choice")) {
  button.addEventListener("click", () => judge(button.dataset.choice));
}
find("#help-button").addEventListener("click", openHelp);
find("#undo").addEventListener("click", undo);
for (const kind of ["pointerdown", "pointermove"]) {
  document.addEventListener(kind, () => current?.watch?.input(), { passive: true });
}
let resizeTimer = null;
window.addEventListener("resize", () => {
  clearTimeout(resizeTimer);
  resizeTimer = setTimeout(() => current?.player?.setView(transport.view), 200);
});

enable("#help-button");
showOutbox(outbox);
showNext();
