// The campaign page: fetches everything, follows the server's events, and wires the buttons.

import { ApiError, get, signInAddress } from "./api.js";
import { gate, legend, measures, pathMap } from "./behaviour.js";
import { campaignActions } from "./campaign-actions.js";
import { drawCurves } from "./curves.js";
import { describe, element, find, replace } from "./dom.js";
import { isRunning, liveCollect, liveRound, showProgress } from "./live.js";
import * as panels from "./panels.js";

const id = document.body.dataset.campaignId;
const REFRESH_MS = 900; // at most this often, however fast events come
const IDLE_REFRESH_MS = 15_000; // should the event stream be cut by a proxy
const PAIRS_AT_ONCE = 24;
const JOBS_AT_ONCE = 20; // of each of these states:
const JOB_STATES = ["failed", "running", "queued"];

const data = { campaign: null, stats: null, rounds: [], jobs: [], checkpoints: [], pairs: [], pairCursor: null };
let chosenRound = null; // id; null follows the newest with a result
let drawnCurves = "";
const actions = campaignActions(id, data, () => refresh());

// ---- loading ---------------------------------------------------------------------------------

async function load() {
  const [campaign, stats, rounds, pairs, ...jobs] = await Promise.all([
    get(`/campaigns/${id}`), get(`/campaigns/${id}/stats`), get(`/campaigns/${id}/rounds`),
    get(`/campaigns/${id}/pairs?limit=${PAIRS_AT_ONCE}`),
    ...JOB_STATES.map((state) => get(`/jobs?campaign_id=${id}&state=${state}&limit=${JOBS_AT_ONCE}`)),
  ]);
  const checkpoints = await get(`/checkpoints?task=${encodeURIComponent(campaign.task)}`);
  Object.assign(data, { campaign, stats, rounds, jobs: jobs.flat(), checkpoints });
  if (data.pairs.length <= PAIRS_AT_ONCE) Object.assign(data, { pairs: pairs.items, pairCursor: pairs.next_cursor });
  draw();
}

let refreshing = null;
let again = false;

// Calls that come while it runs lead to one more run.
async function refresh() {
  if (refreshing) {
    again = true;
    return;
  }
  refreshing = load();
  try {
    await refreshing;
    find("#banner").hidden = true;
  } catch (error) {
    complain(error);
  }
  await new Promise((resolve) => setTimeout(resolve, REFRESH_MS));
  refreshing = null;
  if (again) {
    again = false;
    refresh();
  }
}

function complain(error) {
  if (error instanceof ApiError && error.status === 401) {
    location.assign(signInAddress());
    return;
  }
  const banner = find("#banner");
  replace(banner, element("span", {}, describe(error)), element("button.link", { type: "button", onclick: refresh }, "Try again"));
  banner.hidden = false;
}

function follow() {
  const stream = new EventSource(`/api/v1/campaigns/${id}/events`);
  for (const name of ["progress", "state", "curve", "label", "publication"]) {
    stream.addEventListener(name, (event) => {
      if (name === "progress") showProgress(JSON.parse(event.data));
      refresh();
    });
  }
}

// ---- drawing ---------------------------------------------------------------------------------

const publishedId = () => data.campaign.published_checkpoint_id;

// What is known of a checkpoint: as candidate of its round, as parent of a later one, or shipped.
function evaluationOf(checkpoint) {
  for (const round of data.rounds) {
    if (round.candidate_checkpoint_id === checkpoint.id && round.result?.after) return round.result.after;
  }
  for (const round of data.rounds) {
    if (round.parent_checkpoint_id === checkpoint.id && round.result?.before) return round.result.before;
  }
  const { metrics } = checkpoint;
  return [metrics.evaluation, metrics.measured, metrics].find((item) => typeof item?.success === "number") ?? null;
}

const roundOf = (checkpoint) => data.rounds.find((round) => round.id === checkpoint.round_id);
const isComparison = (checkpoint) => roundOf(checkpoint)?.publish_rule === "never";
const taskFacts = () => data.checkpoints.find((item) => item.id === publishedId())?.config.task_facts;

// The newest round that says something about the published line; comparison rounds come after.
function shownRound() {
  const measured = data.rounds.filter((round) => round.result?.before);
  return data.rounds.find((round) => round.id === chosenRound)
    ?? measured.find((round) => round.publish_rule !== "never") ?? measured[0] ?? data.rounds[0] ?? null;
}

function draw() {
  const published = data.checkpoints.find((item) => item.id === publishedId());
  find("#published").textContent = published ? `Published policy: ${published.name}` : "";
  find(".criterion-text").textContent = `“${data.campaign.criterion}”`;
  find("#rollback").disabled = publishedId() === data.campaign.start_checkpoint_id;
  replace(find("#tiles"), panels.tiles(data.stats, published ? evaluationOf(published) : null));
  replace(find("#annotators"), panels.annotatorTable(data.stats.annotators));
  const noisy = shownRound()?.noise ? shownRound() : data.rounds.find((round) => round.noise);
  replace(find("#answers"), panels.answerBars(data.stats.labels), panels.noiseText(noisy));
  replace(find("#rounds"), panels.roundTable(data.rounds, shownRound()?.id, {
    onSelect: select, onPublish: actions.publish, publishedId: publishedId(),
  }));
  replace(find("#checkpoints"), panels.checkpointTable(data.checkpoints, {
    publishedId: publishedId(), evaluationOf, isComparison, onLineage: actions.lineage, onPublish: actions.publish,
  }));
  drawPairs();
  drawJobs();
  drawLive();
  drawBehaviour();
  drawCurvesOf(shownRound());
}

function drawPairs() {
  const { pairs } = data;
  find("#pairs-note").textContent = pairs.length > 0 ? "as annotators see them: A left, B right" : "";
  const more = data.pairCursor
    ? element("div.more-row", {}, element("button.button.small", { type: "button", onclick: morePairs }, "Show more"))
    : null;
  const nothing = element("div.empty", {}, element("strong", {}, "No pairs yet"), "Collect runs: pairs are chosen among them and made into replays.");
  const box = find("#pairs");
  box.classList.toggle("pair-grid", pairs.length > 0);
  // Pictures that are there stay, so that their motion does not start anew at every refresh.
  const shown = box.dataset.shown;
  const now = JSON.stringify([pairs.map((pair) => [pair.id, pair.thumbnail_url, pair.state]), data.pairCursor]);
  if (shown === now) return;
  box.dataset.shown = now;
  replace(box, pairs.length > 0 ? panels.pairCards(pairs) : nothing, more);
}

async function morePairs() {
  try {
    const page = await get(`/campaigns/${id}/pairs?limit=${PAIRS_AT_ONCE}&cursor=${data.pairCursor}`);
    data.pairs = [...data.pairs, ...page.items];
    data.pairCursor = page.next_cursor;
    drawPairs();
  } catch (error) {
    complain(error);
  }
}

function drawJobs() {
  const { queued, running, failed } = data.stats.jobs;
  find("#jobs-note").textContent = `${queued} queued · ${running} running · ${failed} failed`;
  replace(find("#jobs"), panels.jobTable(data.jobs.slice(0, JOBS_AT_ONCE), { onRetry: actions.retry }));
}

function drawLive() {
  const rounds = data.rounds.filter(isRunning);
  const open = data.jobs.filter((job) => job.state !== "failed");
  const collecting = open.filter((job) => job.kind === "collect");
  const jobOf = (round) => open.find((job) => job.round_id === round.id);
  replace(
    find("#live"),
    rounds.map((round) => liveRound(round, jobOf(round), () => actions.cancel(round))), collecting.map(liveCollect),
  );
}

function drawBehaviour() {
  const choice = find("#round-choice");
  const shown = shownRound();
  const measured = data.rounds.filter((round) => round.result?.before);
  choice.parentElement.hidden = measured.length === 0;
  if (document.activeElement !== choice) {
    replace(choice, measured.map((round) => element(
      "option", { value: round.id, selected: round.id === shown?.id },
      `${round.id} · ${round.config.method}${round.publish_rule === "never" ? " (comparison)" : ""}`,
    )));
  }
  const box = find("#behaviour");
  const facts = taskFacts();
  const { before, after, gate: verdict } = shown?.result ?? {};
  const key = JSON.stringify([shown?.id, shown?.state, Boolean(before), Boolean(after)]);
  if (box.dataset.shown === key) return;
  box.dataset.shown = key;
  if (!before || !facts) {
    replace(box, element("div.empty", {}, element("strong", {}, "No round has been evaluated yet"),
      "After a round, this shows what the policy does before and after, with intervals."));
    return;
  }
  replace(box, element(
    "div.behaviour", {},
    element("div", {}, measures(before, after), gate(verdict, shown.state)),
    element("div", {},
      element("div.maps", {}, pathMap("Before", before, facts), after ? pathMap("After", after, facts) : null),
      legend([before, after], facts)),
  ));
}

async function drawCurvesOf(round) {
  if (!round) return;
  try {
    const points = await get(`/rounds/${round.id}/curves`);
    const key = `${round.id}:${points.length}`;
    if (key === drawnCurves) return;
    const card = find("#curves-card");
    const some = points.some((point) => typeof point.loss === "number" || typeof point.mean_vote === "number");
    card.hidden = !some;
    find("#curves-note").textContent = `round ${round.id}, ${round.config.method}`;
    if (some) await drawCurves(points);
    drawnCurves = key;
  } catch (error) {
    complain(error);
  }
}

function select(roundId) {
  chosenRound = roundId;
  draw();
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
setInterval(refresh, IDLE_REFRESH_MS);
await refresh();
follow();
