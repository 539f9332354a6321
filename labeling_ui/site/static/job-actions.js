// What the buttons of single jobs do.

import { post } from "./api.js";
import { ask, toast } from "./dom.js";

const LOSS = {
  collect: "The runs that are stored stay. No more pairs are made of them.",
  replay: "Its pair is not handed out.",
};

// Only collections and replays: the jobs of a round end with it.
export const canBeCancelled = (job) =>
  job.round_id === null && (job.state === "queued" || job.state === "running");

export async function cancelJob(job, refresh) {
  const values = await ask({
    title: `Cancel ${job.kind} ${job.id}?`,
    text: LOSS[job.kind] ?? "",
    confirm: "Cancel job",
    dismiss: "Keep it",
    danger: true,
    onSubmit: () => post(`/jobs/${job.id}/cancel`),
  });
  if (values) toast(`Job ${job.id} is cancelled.`);
  refresh();
}
