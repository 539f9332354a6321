// Numbers, times and names as people read them.

export const percent = (rate, digits = 0) =>
  rate === null || rate === undefined ? "–" : `${(100 * rate).toFixed(digits)} %`;

export const interval = (pair) =>
  Array.isArray(pair) ? `${(100 * pair[0]).toFixed(0)}–${(100 * pair[1]).toFixed(0)}` : "";

export const count = (value) => (value ?? 0).toLocaleString("en-GB");

export function duration(milliseconds) {
  if (milliseconds === null || milliseconds === undefined) return "–";
  const seconds = milliseconds / 1000;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 99.5) return `${Math.round(seconds)} s`;
  const whole = Math.round(seconds); // first, or 119.6 s would be 1 min 60 s
  return `${Math.floor(whole / 60)} min ${whole % 60} s`;
}

export function ago(text, now = Date.now()) {
  if (!text) return "–";
  const seconds = Math.max(0, (now - new Date(text).getTime()) / 1000);
  if (seconds < 45) return "just now";
  if (seconds < 3600) return `${Math.round(seconds / 60)} min ago`;
  if (seconds < 86_400) return `${Math.round(seconds / 3600)} h ago`;
  return day(text);
}

export const day = (text) =>
  new Date(text).toLocaleDateString("en-GB", { day: "numeric", month: "short", year: "numeric" });

export const moment = (text) =>
  new Date(text).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });

export const CHOICES = { left: "A is better", right: "B is better", equal: "Equal", cannot_tell: "Can’t tell" };

const SPELLINGS = {
  finetuning: "fine-tuning", finetune: "fine-tune", bradley_terry: "Bradley–Terry", dawid_skene: "Dawid–Skene",
};
export const words = (name) => SPELLINGS[name] ?? String(name ?? "").replaceAll("_", " ");

// What a job is at, in words; of a fine-tuning as rodif_core/guided.py names it.
const STAGES = {
  score: "scoring the labelled runs", choose: "trying scales on fresh runs", "choose again": "trying self-training on fresh runs",
};
export const stageWords = (name) =>
  STAGES[name] ?? words(name).replace(/^guide s=(.+)$/, "guidance of scale $1");

export const short = (digest) => String(digest ?? "").slice(0, 10);
