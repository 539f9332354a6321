// The campaign page: fetches everything, follows the server's events, and wires the buttons.

import { ApiError, get, post, signInAddress } from "./api.js";
import { gate, legend, measures, pathMap } from "./behaviour.js";
import { drawCurves } from "./curves.js";
import { ask, describe, element, find, replace, toast } from "./dom.js";
import { percent, words } from "./format.js";
import * as panels from "./panels.js";

const id = document.body.dataset.campaignId;
const REFRESH_MS = 900; // at most this often, however fast events come
const IDLE_REFRESH_MS = 15_000; // should the event stream be cut by a proxy
const PAIRS_AT_ONCE = 24;
const STAGES = [["queued", "Queued"], ["finetuning", "Fine-tuning"], ["evaluating", "Evaluation"], ["gating", "Gate"]];
const RUNNING = STAGES.map(([state]) => state);

const data = { campaign: null, stats: null, rounds: [], jobs: [], checkpoints: [], pairs: [], pairCursor: null };
let chosenRound = null; // id; null follows the newest with a result
let drawnCurves = "";

// ---- loading ---------------------------------------------------------------------------------

async function load() {
  const [campaign, stats, rounds, jobs, pairs] = await Promise.all([
    get(`/campaigns/${id}`), get(`/campaigns/${id}/stats`), get(`/campaigns/${id}/rounds`),
    get(`/jobs?campaign_id=${id}&limit=200`), get(`/campaigns/${id}/pairs?limit=${PAIRS_AT_ONCE}`),
  ]);
  const checkpoints = await get(`/checkpoints?task=${encodeURIComponent(campaign.task)}`);
  Object.assign(data, { campaign, stats, rounds, jobs, checkpoints });
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
  find("#rollback").disabled = publishedId() === data.campaign.start_checkpoint_id;
  replace(find("#tiles"), panels.tiles(data.stats, published ? evaluationOf(published) : null));
  replace(find("#annotators"), panels.annotatorTable(data.stats.annotators));
  const noisy = data.rounds.find((round) => round.noise);
  replace(find("#answers"), panels.answerBars(data.stats.labels), panels.noiseText(noisy));
  const actions = { onSelect: select, onPublish: publish, publishedId: publishedId() };
  replace(find("#rounds"), panels.roundTable(data.rounds, shownRound()?.id, actions));
  replace(find("#checkpoints"), panels.checkpointTable(data.checkpoints, {
    publishedId: publishedId(), evaluationOf, isComparison, onLineage: lineage, onPublish: publish,
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
    ? element("button.button.small", { type: "button", onclick: morePairs }, "Show more") : null;
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
  const notable = data.jobs.filter((job) => ["queued", "running", "failed"].includes(job.state));
  const first = notable.sort((one, other) => order(one) - order(other)).slice(0, 12);
  const { queued, running, failed } = data.stats.jobs;
  find("#jobs-note").textContent = `${queued} queued · ${running} running · ${failed} failed`;
  replace(find("#jobs"), panels.jobTable(first, { onRetry: retry }));
}

const order = (job) => ["failed", "running", "queued"].indexOf(job.state);

function drawLive() {
  const rounds = data.rounds.filter((round) => RUNNING.includes(round.state));
  const collecting = data.jobs.filter((job) => job.kind === "collect" && ["queued", "running"].includes(job.state));
  replace(find("#live"), rounds.map(liveRound), collecting.map(liveCollect));
}

function meter(job) {
  const share = job?.progress ?? 0;
  return [
    element("div.meter", { role: "progressbar", "aria-valuenow": Math.round(100 * share), "aria-valuemin": 0, "aria-valuemax": 100 },
      element("div", { style: `width:${100 * share}%` })),
    element("p.small.muted.live-stage", {}, job ? `${words(job.stage) || "waiting"} · ${percent(share)}` : "waiting for a worker"),
  ];
}

function liveRound(round) {
  const now = RUNNING.indexOf(round.state);
  const job = data.jobs.find((item) => item.round_id === round.id && ["queued", "running"].includes(item.state));
  const steps = STAGES.map(([, name], index) =>
    element(`li${index < now ? ".past" : index === now ? ".now" : ""}`, {}, name));
  return element(
    "div.card.live", { dataset: { liveRound: round.id, job: job?.id } },
    element(
      "div.live-head", {},
      element("h2", {}, `Round ${round.id} is running`), element("span.muted", {}, `${round.config.method} on ${round.labels} labels`),
      element("button.button.small", { type: "button", onclick: () => cancel(round) }, "Cancel"),
    ),
    element("ul.stages", {}, steps), meter(job),
  );
}

function liveCollect(job) {
  return element(
    "div.card.live", { dataset: { job: job.id } },
    element("div.live-head", {}, element("h2", {}, "Collecting runs of the published policy")), meter(job),
  );
}

// Moves the meter at once; everything else follows with the next refresh.
function showProgress({ job_id: jobId, progress, stage }) {
  const card = find(`.live[data-job="${jobId}"]`);
  if (!card || typeof progress !== "number") return;
  find(".meter > div", card).style.width = `${100 * progress}%`;
  find(".live-stage", card).textContent = `${words(stage)} · ${percent(progress)}`;
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

// ---- actions ---------------------------------------------------------------------------------

async function collect() {
  const usual = data.campaign.settings.collect;
  await ask({
    title: "Collect runs",
    text: "Rolls out the published policy and makes replays of the pairs that say most.",
    confirm: "Collect",
    fields: [
      { name: "episodes", label: "Runs", kind: "number", value: usual.episodes, min: 2, max: 5000, step: 1, required: true },
      { name: "pairs", label: "Pairs", kind: "number", value: usual.pairs, min: 1, max: 20000, step: 1, required: true },
      { name: "strategy", label: "Choice of pairs", kind: "select", value: usual.strategy, options: [["cross_group", "Different behaviour against each other"], ["random", "Random"]] },
    ],
    onSubmit: (values) => post(`/campaigns/${id}/collect`, values),
  }) && toast("Collecting has started.");
  refresh();
}

const METHODS = [
  ["rodif_guided", "rodif_guided: RoDiF scores, guidance moves the policy"],
  ["rodif", "rodif: the paper’s robust loss"],
  ["dp_dpo", "dp_dpo: the paper’s baseline"],
];
const RULES = [
  ["auto", "Publish when the gate passes"], ["manual", "Wait for an admin"], ["never", "Comparison only"],
];

async function startRound() {
  const { settings } = data.campaign;
  const labels = data.stats.labels.effective;
  await ask({
    title: "Start a round",
    text: `Freezes ${labels} labels, fine-tunes the published policy on them and evaluates the result.`,
    confirm: "Start round",
    fields: [
      { name: "method", label: "Method", kind: "select", value: settings.method, options: METHODS },
      { name: "gamma", label: "Conservativeness γ", kind: "number", min: 0, max: 0.99, step: "any", placeholder: "from the labels", hint: "Empty: estimated from the labels. At least the share of wrong labels, below 0.5." },
      { name: "publish_rule", label: "Publishing", kind: "select", value: settings.publish_rule, options: RULES },
      { name: "episodes", label: "Evaluation runs", kind: "number", value: settings.evaluation_episodes, min: 10, max: 10000, step: 1, required: true },
    ],
    onSubmit: async ({ method, gamma, publish_rule, episodes }) => {
      const config = gamma === null ? { method } : { method, conservativeness: gamma };
      const round = await post(`/campaigns/${id}/rounds`, { config, publish_rule, evaluation: { episodes } });
      toast(`Round ${round.id} has started.`);
    },
  });
  chosenRound = null;
  refresh();
}

async function publish(checkpointId) {
  const { name } = data.checkpoints.find((item) => item.id === checkpointId);
  const done = await ask({
    title: `Publish ${name}?`,
    text: "From now on runs are collected from it, and rounds start from it. It can be rolled back.",
    confirm: "Publish",
    fields: [{ name: "reason", label: "Reason", value: "", placeholder: "kept in the audit trail" }],
    onSubmit: ({ reason }) => post(`/campaigns/${id}/publish`, { checkpoint_id: checkpointId, reason }),
  });
  if (done) toast(`${name} is published.`);
  refresh();
}

async function rollBack() {
  const done = await ask({
    title: "Roll back?",
    text: "Publishes again what was published before. Nothing is deleted.",
    confirm: "Roll back",
    danger: true,
    fields: [{ name: "reason", label: "Reason", value: "", placeholder: "kept in the audit trail" }],
    onSubmit: ({ reason }) => post(`/campaigns/${id}/rollback`, { reason }),
  });
  if (done) toast("Rolled back.");
  refresh();
}

async function cancel(round) {
  const done = await ask({
    title: `Cancel round ${round.id}?`, text: "The labels stay; the round can be started again.",
    confirm: "Cancel round", danger: true,
    onSubmit: () => post(`/rounds/${round.id}/cancel`),
  });
  if (done) toast(`Round ${round.id} is cancelled.`);
  refresh();
}

async function retry(job) {
  try {
    await post(`/jobs/${job.id}/retry`);
    toast(`Job ${job.id} is queued again.`);
  } catch (error) {
    toast(describe(error), { bad: true, seconds: 12 });
  }
  refresh();
}

async function lineage(checkpoint) {
  try {
    const steps = await get(`/checkpoints/${checkpoint.id}/lineage`);
    const close = element("button.button.primary", { value: "close" }, "Close");
    const dialog = element(
      "dialog.dialog.broad", { "aria-label": "Lineage" },
      element("h2", {}, `Lineage of ${checkpoint.name}`), panels.lineageList(steps),
      element("form.dialog-actions", { method: "dialog" }, close),
    );
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    dialog.showModal();
  } catch (error) {
    toast(describe(error), { bad: true, seconds: 12 });
  }
}

find("#collect").addEventListener("click", collect);
find("#start-round").addEventListener("click", startRound);
find("#rollback").addEventListener("click", rollBack);
find("#round-choice").addEventListener("change", (event) => {
  event.target.blur();
  select(Number(event.target.value));
});
setInterval(refresh, IDLE_REFRESH_MS);
await refresh();
follow();
