// Cards of what is running now: rounds with their stages, and collections.

import { element, find } from "./dom.js";
import { percent, stageWords } from "./format.js";

const STAGES = [["queued", "Queued"], ["finetuning", "Fine-tuning"], ["evaluating", "Evaluation"], ["gating", "Gate"]];
const RUNNING = STAGES.map(([state]) => state);

export const isRunning = (round) => RUNNING.includes(round.state);

function meter(job) {
  const share = job?.progress ?? 0;
  const before = job?.state === "running" ? "starting" : "waiting for a worker";
  const now = { role: "progressbar", "aria-label": "Progress of this stage", "aria-valuenow": Math.round(100 * share), "aria-valuemin": 0, "aria-valuemax": 100 };
  return [
    element("div.meter", now, element("div", { style: `width:${100 * share}%` })),
    element("p.small.muted.live-stage", {}, job?.stage ? `${stageWords(job.stage)} · ${percent(share)}` : before),
  ];
}

export function liveRound(round, job, onCancel) {
  const now = RUNNING.indexOf(round.state);
  const steps = STAGES.map(([, name], index) =>
    element(`li${index < now ? ".past" : index === now ? ".now" : ""}`, {}, name));
  return element(
    "div.card.live", { dataset: { key: `round ${round.id}`, job: job?.id ?? "" } },
    element(
      "div.live-head", {},
      element("h2", {}, `Round ${round.id} is running`),
      element("span.muted", {}, `${round.config.method} on ${round.labels} labels`),
      element("button.button.small", { type: "button", onclick: onCancel }, "Cancel"),
    ),
    element("ul.stages", {}, steps), meter(job),
  );
}

export function liveCollect(job, onCancel) {
  return element(
    "div.card.live", { dataset: { key: `job ${job.id}`, job: job.id } },
    element(
      "div.live-head", {},
      element("h2", {}, "Collecting runs of the published policy"),
      element("button.button.small", { type: "button", onclick: onCancel }, "Cancel"),
    ),
    meter(job),
  );
}

// What a screen reader is told: only this, and only when it changes.
export function liveWords(rounds, collecting) {
  const stage = new Map(STAGES);
  return [
    ...rounds.map((round) => `Round ${round.id}: ${stage.get(round.state)}.`),
    collecting.length > 0 ? "Collecting runs." : null,
  ].filter(Boolean).join(" ");
}

// Moves the meter at once; everything else follows with the next refresh.
export function showProgress({ job_id: jobId, progress, stage }) {
  const card = find(`.live[data-job="${jobId}"]`);
  if (!card || typeof progress !== "number") return;
  find(".meter > div", card).style.width = `${100 * progress}%`;
  find(".meter", card).setAttribute("aria-valuenow", Math.round(100 * progress));
  find(".live-stage", card).textContent = `${stageWords(stage)} · ${percent(progress)}`;
}
