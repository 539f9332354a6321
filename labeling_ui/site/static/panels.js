// Tables and tiles of the campaign page. Each function takes data and returns elements.

import { element } from "./dom.js";
import { ago, count, duration, interval, percent, short, stageWords, words } from "./format.js";
import { canBeCancelled } from "./job-actions.js";

const STATE_LOOK = {
  published: "good", done: "good", ready: "good",
  rejected: "warn", kept: "warn", cancelled: "warn",
  failed: "bad",
  finetuning: "busy", evaluating: "busy", gating: "busy", running: "busy",
};

export const pill = (state) => element(`span.pill${STATE_LOOK[state] ? `.${STATE_LOOK[state]}` : ""}`, {}, words(state));

export function table(heads, rows, nothing) {
  if (rows.length === 0) return element("div.empty", {}, nothing);
  const head = heads.map(([name, look]) => element(`th${look ? `.${look}` : ""}`, { scope: "col" }, name));
  return element("table", {}, element("thead", {}, element("tr", {}, head)), element("tbody", {}, rows));
}

const cell = (content, look = "") => element(`td${look}`, {}, content);
const under = (text) => element("span.under", {}, text);

function tile(name, value, more = "") {
  return element(
    "div.tile", {}, element("div.name", {}, name), element("div.value", {}, value), element("div.more", {}, more),
  );
}

export function tiles(stats, evaluation) {
  const { pairs, labels } = stats;
  const open = [
    pairs.waiting > 0 ? `${count(pairs.waiting)} being made` : null,
    pairs.failed > 0 ? `${count(pairs.failed)} failed` : null,
    pairs.reported > 0 ? `${count(pairs.reported)} reported: the replay does not play` : null,
    `${count(pairs.labelled)} labelled`,
  ];
  const rate = (key) => {
    if (!evaluation) return ["–", "not measured yet"];
    const range = evaluation.intervals?.[key];
    return [percent(evaluation[key]), range ? `95 %: ${interval(range)} · n = ${evaluation.n}` : `n = ${evaluation.n}`];
  };
  return [
    tile("Runs", count(stats.episodes), "of all collected policies"),
    tile("Pairs", count(pairs.ready), open.filter(Boolean).join(" · ")),
    tile("Labels", count(labels.effective), `${count(labels.new_since_round)} since the last round`),
    tile("Success, published", ...rate("success")),
    tile("Alignment, published", ...rate("alignment")),
    tile("Off the data", ...rate("off_support")),
  ];
}

export function annotatorTable(annotators) {
  const rows = annotators.map((person) => element(
    "tr", { dataset: { key: person.id } },
    cell([person.name, person.kind === "simulated" ? under("simulated") : null]),
    cell(count(person.labels), ".number"),
    cell(duration(person.median_duration_ms), ".number"),
    cell(percent(person.left_share), ".number"),
  ));
  const heads = [["Name"], ["Labels", "number"], ["Median time", "number"], ["Chose left", "number"]];
  return table(heads, rows, "Nobody has labelled yet.");
}

const ANSWERS = { first: "first run", second: "second run", equal: "equal", cannot_tell: "can’t tell" };

export function answerBars(labels) {
  const total = Math.max(1, labels.effective);
  return Object.entries(ANSWERS).map(([choice, name]) => {
    const number = labels.by_choice?.[choice] ?? 0;
    return element(
      "div.answer", {},
      element("span", {}, name),
      element("div.meter", {}, element("div", { style: `width:${(100 * number) / total}%` })),
      element("span.muted", {}, count(number)),
    );
  });
}

export function noiseText(round) {
  const noise = round?.noise;
  if (!noise) return null;
  const parts = Object.entries(noise.estimates ?? {})
    .filter(([, value]) => typeof value === "number")
    .map(([name, value]) => `${words(name)} ${percent(value)}`);
  const origin = noise.source === "given" ? "given" : "estimated from the labels";
  return element(
    "p.noise", {},
    element("strong", {}, `γ = ${noise.conservativeness.toFixed(2)}`), ` in round ${round.id}, ${origin}`,
    parts.length > 0 ? `. Noise: ${parts.join(", ")}.` : ".",
  );
}

// Beside the publishing rule "manual", "manual" would say the wrong thing.
const TRIGGERS = { manual: "started by hand", labels: "enough new labels", periodic: "by the clock" };

const arrow = (before, after, key) =>
  after ? `${percent(before?.[key])} → ${percent(after[key])}` : "–";

export function roundTable(rounds, selected, { onSelect, onPublish, publishedId }) {
  const rows = rounds.map((round) => {
    const { before, after } = round.result ?? {};
    const mayPublish = round.candidate_checkpoint_id && round.publish_rule !== "never"
      && ["kept", "rejected"].includes(round.state) && round.candidate_checkpoint_id !== publishedId;
    return element(
      `tr${round.id === selected ? ".selected" : ""}`, { dataset: { key: round.id, round: round.id } },
      cell(element("button.link", { type: "button", onclick: () => onSelect(round.id) }, `Round ${round.id}`)),
      cell([pill(round.state), round.error ? under(element("span.error-text", {}, round.error)) : null]),
      cell([round.config.method, under(round.publish_rule === "never" ? "comparison" : TRIGGERS[round.trigger] ?? words(round.trigger))]),
      cell(count(round.labels), ".number"),
      cell(round.noise ? round.noise.conservativeness.toFixed(2) : "–", ".number"),
      cell(arrow(before, after, "success"), ".number"),
      cell(arrow(before, after, "alignment"), ".number"),
      cell(ago(round.created_at), ".tight"),
      cell(mayPublish ? element("button.button.small", { type: "button", "aria-label": `Publish the policy of round ${round.id}`, onclick: () => onPublish(round.candidate_checkpoint_id) }, "Publish") : null, ".tight"),
    );
  });
  const heads = [
    ["Round"], ["State"], ["Method"], ["Labels", "number"], ["γ", "number"],
    ["Success", "number"], ["Alignment", "number"], ["Started"], [""],
  ];
  return table(heads, rows, "No round yet. Collect runs, have them labelled, then start one.");
}

export function checkpointTable(checkpoints, { publishedId, evaluationOf, onLineage, onPublish }) {
  const rows = checkpoints.map((checkpoint) => {
    const evaluation = evaluationOf(checkpoint);
    const rate = (key) => evaluation
      ? [percent(evaluation[key]), under(interval(evaluation.intervals?.[key]))] : "–";
    const published = checkpoint.id === publishedId;
    return element(
      "tr", { dataset: { key: checkpoint.id, checkpoint: checkpoint.id } },
      cell([checkpoint.name, under(element("code", {}, short(checkpoint.digest)))]),
      cell(published ? element("span.pill.good", {}, "published") : checkpoint.comparison ? element("span.pill", {}, "comparison") : null),
      cell(rate("success"), ".number"), cell(rate("alignment"), ".number"), cell(rate("off_support"), ".number"),
      cell(ago(checkpoint.created_at), ".tight"),
      cell([
        element("button.button.small", { type: "button", "aria-label": `Lineage of ${checkpoint.name}`, onclick: () => onLineage(checkpoint) }, "Lineage"), " ",
        element("a.button.small", { href: `/api/v1/checkpoints/${checkpoint.id}/file`, download: "", "aria-label": `Download ${checkpoint.name}` }, "Download"), " ",
        published || checkpoint.comparison ? null
          : element("button.button.small", { type: "button", "aria-label": `Publish ${checkpoint.name}`, onclick: () => onPublish(checkpoint.id) }, "Publish"),
      ], ".tight"),
    );
  });
  const heads = [["Checkpoint"], [""], ["Success", "number"], ["Alignment", "number"], ["Off the data", "number"], ["Made"], [""]];
  return table(heads, rows, "No checkpoint.");
}

// What can be done about a job by hand, if anything.
function jobButton(job, onRetry, onCancel) {
  const what = `${words(job.kind)} ${job.id}`;
  const button = (name, onclick) => element("button.button.small", { type: "button", "aria-label": `${name} ${what}`, onclick }, name);
  if (job.state === "failed") return button("Retry", () => onRetry(job));
  return canBeCancelled(job) ? button("Cancel", () => onCancel(job)) : null;
}

export function jobTable(jobs, { onRetry, onCancel }) {
  const rows = jobs.map((job) => element(
    "tr", { dataset: { key: job.id, job: job.id } },
    cell(`${words(job.kind)} ${job.id}`),
    cell([pill(job.state), job.error ? under(element("span.error-text", {}, job.error)) : null]),
    cell([stageWords(job.stage), job.state === "running" ? under(percent(job.progress)) : null]),
    cell(job.attempt, ".number"),
    cell(ago(job.finished_at ?? job.started_at ?? job.created_at), ".tight"),
    cell(jobButton(job, onRetry, onCancel), ".tight"),
  ));
  return table([["Job"], ["State"], ["Stage"], ["Attempts", "number"], ["When"], [""]], rows, "Nothing is waiting, running or failed.");
}

// onWatch: (id of a pair) => …
export function pairCards(pairs, onWatch) {
  return pairs.map((pair) => element(
    "figure.pair", { dataset: { key: pair.id, pair: pair.id } },
    element(
      "button.pair-open", { type: "button", title: "Watch it, and see the answers", "aria-label": `Watch pair ${pair.id}`, onclick: () => onWatch(pair.id) },
      pair.thumbnail_url
        ? element("img", { src: pair.thumbnail_url, loading: "lazy", alt: `Paths of pair ${pair.id}` })
        : element("div.blank", {}, words(pair.state)),
    ),
    element("figcaption", {}, element("span", {}, `Pair ${pair.id}`), element("span", {}, words(pair.reason))),
  ));
}

export function lineageList(steps) {
  return element(
    "ol.lineage", {},
    steps.map((step) => {
      const people = step.labels_by_annotator.map((item) => `${item.name} ${count(item.labels)}`).join(", ");
      const method = step.config?.method;
      return element(
        "li", {},
        element("strong", {}, step.checkpoint.name), " ", element("code.muted", {}, short(step.checkpoint.digest)),
        step.round_id === null
          ? element("p.muted.small", {}, "pretrained, no labels behind it")
          : element("p.muted.small", {}, `Round ${step.round_id}, ${method}, configuration ${short(step.config_digest)}`),
        step.round_id === null ? null
          : element("p.muted.small", {}, `${count(step.labels)} labels (snapshot ${short(step.snapshot_digest)}): ${people}`),
        element("p.muted.small", {}, `code version ${step.code_version}`),
      );
    }),
  );
}
