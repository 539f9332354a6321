// The campaign page: draws what there is, follows the server's events, and wires the buttons.

import { ApiError, get, signInAddress } from "./api.js";
import { gate, legend, measures, pathMap } from "./behaviour.js";
import { campaignActions } from "./campaign-actions.js";
import { campaignData, PARTS } from "./campaign-data.js";
import { drawCurves } from "./curves.js";
import { describe, element, enable, find, replace } from "./dom.js";
import { cancelJob } from "./job-actions.js";
import { isRunning, liveCollect, liveRound, liveWords, showProgress } from "./live.js";
import { watchPair } from "./pair-watch.js";
import * as panels from "./panels.js";
import { watchSystem } from "./readiness.js";
import { renew } from "./steady.js";

const id = document.body.dataset.campaignId;
const REFRESH_MS = 900; // at most this often, however fast events come
const IDLE_REFRESH_MS = 15_000; // should the event stream be cut by a proxy
const JOBS_SHOWN = 20;
const STREAM_PATIENCE_MS = 1000; // then the page is drawn without waiting for the stream

const { data, load, loadMore, changedBy, events } = campaignData(id);
let chosenRound = null; // id; null follows the newest with a result
let drawnCurves = "";
const whole = { key: "", round: null }; // the shown round with the paths of its evaluations
const actions = campaignActions(id, data, () => refresh());

// ---- loading ---------------------------------------------------------------------------------

const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const wanted = new Set();
let refreshing = false;

// Without names: all parts. Calls that come while it runs lead to one more run.
async function refresh(...parts) {
  for (const part of parts.length > 0 ? parts : PARTS) wanted.add(part);
  if (refreshing) return;
  refreshing = true;
  while (wanted.size > 0) {
    const now = [...wanted];
    wanted.clear();
    try {
      await load(now);
      draw();
      await drawShownRound(now.includes("curves"));
      find("#banner").hidden = true;
      watchSystem(data.stats.jobs); // not awaited: it may take seconds, and tells by itself
    } catch (error) {
      complain(error);
    }
    await pause(REFRESH_MS);
  }
  refreshing = false;
}

function complain(error) {
  if (error instanceof ApiError && error.status === 401) {
    location.assign(signInAddress());
    return;
  }
  const banner = find("#banner");
  renew(banner, element("span", {}, describe(error)), element("button.link", { type: "button", onclick: () => refresh() }, "Try again"));
  banner.hidden = false;
}

// Resolves when the stream is open: what happens from then on is told, so everything is fetched after it.
function follow() {
  const stream = new EventSource(`/api/v1/campaigns/${id}/events?after=now`);
  for (const name of events) {
    stream.addEventListener(name, (event) => {
      const told = JSON.parse(event.data);
      const parts = changedBy(name, told);
      if (name === "progress") {
        showProgress(told);
        if (data.stats) drawJobs(); // its row says the same
      }
      if (parts.length > 0) refresh(...parts);
    });
  }
  const opened = new Promise((resolve) => { stream.addEventListener("open", resolve, { once: true }); });
  return Promise.race([opened, pause(STREAM_PATIENCE_MS)]);
}

// ---- drawing ---------------------------------------------------------------------------------

const publishedId = () => data.campaign.published_checkpoint_id;

// What is known of a checkpoint: as candidate of its round, as parent of a later one, or shipped. Of
// several measurements the one of most runs, so that a small round does not blur what is known.
function evaluationOf(checkpoint) {
  const { metrics } = checkpoint;
  const known = [
    ...data.rounds.filter((round) => round.candidate_checkpoint_id === checkpoint.id).map((round) => round.result?.after),
    ...data.rounds.filter((round) => round.parent_checkpoint_id === checkpoint.id).map((round) => round.result?.before),
    ...[metrics.evaluation, metrics.measured, metrics].filter((item) => typeof item?.success === "number").slice(0, 1),
  ].filter(Boolean);
  return known.reduce((best, other) => ((other.n ?? 0) > (best.n ?? 0) ? other : best), known[0] ?? null);
}

const taskFacts = () => data.published?.config.task_facts;

// The newest round that says something about the published line; comparison rounds come after.
function shownRound() {
  const measured = data.rounds.filter((round) => round.result?.before);
  return data.rounds.find((round) => round.id === chosenRound)
    ?? measured.find((round) => round.publish_rule !== "never") ?? measured[0] ?? data.rounds[0] ?? null;
}

function draw() {
  if (!data.stats || !data.published) return;
  const { campaign, stats, published } = data;
  for (const place of ["h1", ".crumb:last-child"]) find(place).textContent = campaign.name;
  document.title = `${campaign.name} · RoDiF Studio`;
  find("#archived").hidden = !campaign.archived;
  find("#published").textContent = `Published policy: ${published.name}`;
  find(".criterion-text").textContent = `“${campaign.criterion}”`;
  enable("#collect", "#settings", "#start-round"); // their dialogs show what has been loaded
  for (const name of ["#collect", "#start-round"]) { // the server would refuse both
    find(name).disabled = campaign.archived;
    find(name).title = campaign.archived ? "The campaign is archived: see Settings" : "";
  }
  find("#rollback").disabled = stats.rollback_checkpoint_id === null;
  renew(find("#tiles"), panels.tiles(stats, evaluationOf(published)));
  renew(find("#annotators"), panels.annotatorTable(stats.annotators));
  const noisy = shownRound()?.noise ? shownRound() : data.rounds.find((round) => round.noise);
  renew(find("#answers"), panels.answerBars(stats.labels), panels.noiseText(noisy));
  renew(find("#rounds"), panels.roundTable(data.rounds, shownRound()?.id, {
    onSelect: select, onPublish: actions.publish, publishedId: publishedId(),
  }));
  renew(find("#checkpoints"), panels.checkpointTable(data.checkpoints, {
    publishedId: publishedId(), evaluationOf, onLineage: actions.lineage, onPublish: actions.publish,
  }));
  for (const name of ["rounds", "checkpoints"]) find(`#more-${name}`).hidden = data.cursors[name] === null;
  drawPairs();
  drawJobs();
  drawLive();
}

function drawPairs() {
  const { pairs } = data;
  find("#pairs-note").textContent = pairs.length > 0 ? "as annotators see them: A left, B right" : "";
  const more = data.cursors.pairs
    ? element("div.more-row", {}, element("button.button.small", { type: "button", onclick: () => showMore("pairs") }, "Show more"))
    : null;
  const nothing = element("div.empty", {}, element("strong", {}, "No pairs yet"), "Collect runs: pairs are chosen among them and made into replays.");
  const box = find("#pairs");
  box.classList.toggle("pair-grid", pairs.length > 0);
  renew(box, pairs.length > 0 ? panels.pairCards(pairs, watch) : nothing, more);
}

// As it is known by now: a card may have been drawn before its replay was made.
function watch(pairId) {
  const names = Object.fromEntries(data.stats.annotators.map((one) => [one.id, one.name]));
  return watchPair(data.pairs.find((pair) => pair.id === pairId), names);
}

async function showMore(name) {
  try {
    await loadMore(name);
    draw();
  } catch (error) {
    complain(error);
  }
}

function drawJobs() {
  const { queued, running, failed } = data.stats.jobs;
  const shown = data.jobs.slice(0, JOBS_SHOWN);
  const part = queued + running + failed > shown.length ? ` · ${shown.length} of them shown` : "";
  find("#jobs-note").textContent = `${queued} queued · ${running} running · ${failed} failed${part}`;
  renew(find("#jobs"), panels.jobTable(shown, { onRetry: actions.retry, onCancel: (job) => cancelJob(job, refresh) }));
}

function drawLive() {
  const rounds = data.rounds.filter(isRunning);
  const open = data.jobs.filter((job) => job.state !== "failed");
  const collecting = open.filter((job) => job.kind === "collect");
  const jobOf = (round) => open.find((job) => job.round_id === round.id);
  renew(
    find("#live"),
    rounds.map((round) => liveRound(round, jobOf(round), () => actions.cancel(round))), collecting.map((job) => liveCollect(job, () => cancelJob(job, refresh))),
  );
  renew(find("#live-state"), liveWords(rounds, collecting));
}

// Paths and curves are large: fetched for the one round that is shown, when there is something new.
async function drawShownRound(newPoints) {
  const shown = shownRound();
  const key = JSON.stringify([shown?.id, shown?.state, Boolean(shown?.result?.before), Boolean(shown?.result?.after)]);
  const another = key !== whole.key;
  if (another && shown) whole.round = await get(`/rounds/${shown.id}`);
  whole.key = key;
  drawBehaviour();
  if (another || newPoints) await drawCurvesOf(shown);
}

function drawBehaviour() {
  const shown = shownRound();
  const measured = data.rounds.filter((round) => round.result?.before);
  const choice = find("#round-choice");
  choice.parentElement.hidden = measured.length === 0;
  if (document.activeElement !== choice) {
    renew(choice, measured.map((round) => element(
      "option", { value: round.id, dataset: { key: round.id } },
      `${round.id} · ${round.config.method}${round.publish_rule === "never" ? " (comparison)" : ""}`,
    )));
    choice.value = shown?.id ?? "";
  }
  const box = find("#behaviour");
  const facts = taskFacts();
  const { before, after } = (shown && whole.round?.result) || {};
  if (box.dataset.shown === whole.key) return;
  box.dataset.shown = whole.key;
  if (!before || !facts) {
    replace(box, element("div.empty", {}, element("strong", {}, "No round has been evaluated yet"),
      "After a round, this shows what the policy does before and after, with intervals."));
    return;
  }
  replace(box, element(
    "div.behaviour", {},
    element("div", {}, measures(before, after), gate(whole.round)),
    element("div", {},
      element("div.maps", {}, pathMap("Before", before, facts), after ? pathMap("After", after, facts) : null),
      legend([before, after], facts)),
  ));
}

async function drawCurvesOf(round) {
  if (!round) return;
  const points = await get(`/rounds/${round.id}/curves`);
  const key = `${round.id}:${points.length}`;
  if (key === drawnCurves) return;
  const card = find("#curves-card");
  const some = points.some((point) => typeof point.loss === "number" || typeof point.mean_vote === "number");
  card.hidden = !some;
  find("#curves-note").textContent = `round ${round.id}, ${round.config.method}`;
  if (some) await drawCurves(points);
  drawnCurves = key;
}

async function select(roundId) {
  chosenRound = roundId;
  draw();
  try {
    await drawShownRound(false);
  } catch (error) {
    complain(error);
  }
  find("#behaviour-card").scrollIntoView({ block: "nearest" });
}

find("#collect").addEventListener("click", actions.collect);
find("#settings").addEventListener("click", actions.settings);
find("#rollback").addEventListener("click", actions.rollBack);
find("#start-round").addEventListener("click", async () => {
  if (await actions.startRound()) chosenRound = null;
});
find("#round-choice").addEventListener("change", (event) => {
  event.target.blur();
  select(Number(event.target.value));
});
for (const name of ["rounds", "checkpoints"]) find(`#more-${name} button`).addEventListener("click", () => showMore(name));
setInterval(() => refresh(), IDLE_REFRESH_MS);
await follow();
refresh();
