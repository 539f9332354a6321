// What the buttons of the campaign page do: ask, call the server, tell, and have the page refreshed.

import { get, post, request } from "./api.js";
import { ask, describe, show, toast } from "./dom.js";
import { lineageList } from "./panels.js";

const STRATEGIES = [["cross_group", "Different behaviour against each other"], ["random", "Random"]];
const METHODS = [
  ["rodif_guided", "rodif_guided: RoDiF scores, guidance moves the policy"],
  ["rodif", "rodif: the paper’s robust loss"],
  ["dp_dpo", "dp_dpo: the paper’s baseline"],
  ["ipo", "ipo: pulls ΔQ to a target"],
  ["cpo", "cpo: no reference, clones winners"],
  ["simpo", "simpo: no reference, wants a margin"],
];
const RULES = [
  ["auto", "Publish when the gate passes"], ["manual", "Wait for an admin"], ["never", "Comparison only"],
];
// A text as a form gives it back.
const plain = (text) => text.replaceAll("\r\n", "\n").trim();
const ARCHIVED = [["false", "in use"], ["true", "archived"]];
const REASON = { name: "reason", label: "Reason", value: "", placeholder: "kept in the audit trail" };

// `data` is the page's own object: {campaign, stats, checkpoints, …}, kept up to date by the page.
export function campaignActions(id, data, refresh) {
  // Shows the dialog; `done` is the toast's text when it was confirmed and the server agreed.
  const confirmed = async (done, dialog) => {
    const values = await ask(dialog);
    if (values) toast(done);
    refresh();
    return values !== null;
  };

  const collect = () => {
    const usual = data.campaign.settings.collect;
    return confirmed("Collecting has started.", {
      title: "Collect runs",
      text: "Rolls out the published policy and makes replays of the pairs that say most.",
      confirm: "Collect",
      fields: [
        { name: "episodes", label: "Runs", kind: "number", value: usual.episodes, min: 2, max: 5000, step: 1, required: true },
        { name: "pairs", label: "Pairs", kind: "number", value: usual.pairs, min: 1, max: 20000, step: 1, required: true },
        { name: "strategy", label: "Choice of pairs", kind: "select", value: usual.strategy, options: STRATEGIES },
      ],
      onSubmit: (values) => post(`/campaigns/${id}/collect`, values),
    });
  };

  const startRound = () => {
    const { settings } = data.campaign;
    return confirmed("The round has started.", {
      title: "Start a round",
      text: `Freezes ${data.stats.labels.effective} labels, fine-tunes the published policy on them and evaluates the result.`,
      confirm: "Start round",
      fields: [
        { name: "method", label: "Method", kind: "select", value: settings.method, options: METHODS },
        { name: "gamma", label: "Conservativeness γ", kind: "number", min: 0, max: 0.99, step: "any", placeholder: "from the labels", hint: "Empty: estimated from the labels. At least the share of wrong labels, below 0.5." },
        { name: "publish_rule", label: "Publishing", kind: "select", value: settings.publish_rule, options: RULES },
        { name: "episodes", label: "Evaluation runs", kind: "number", value: settings.evaluation_episodes, min: 10, max: 10000, step: 1, required: true },
      ],
      onSubmit: ({ method, gamma, publish_rule, episodes }) => {
        const config = gamma === null ? { method } : { method, conservativeness: gamma };
        return post(`/campaigns/${id}/rounds`, { config, publish_rule, evaluation: { episodes } });
      },
    });
  };

  const settings = () => {
    const before = data.campaign; // as the dialog shows it; the page goes on refreshing its own
    const now = before.settings;
    return confirmed("The settings are stored.", {
      title: "Settings",
      confirm: "Save",
      fields: [
        { name: "name", label: "Name", value: before.name, required: true },
        { name: "criterion", label: "What annotators are asked", kind: "textarea", value: before.criterion, required: true },
        { name: "labels_per_pair", label: "Labels per pair", kind: "number", value: now.labels_per_pair, min: 1, max: 20, step: 1, required: true, hint: "Two or more let the noise be measured from overlap." },
        { name: "round_after_labels", label: "Start a round by itself after this many new labels", kind: "number", value: now.round_after_labels, min: 0, step: 1, required: true, hint: "0: only by hand." },
        { name: "round_every_minutes", label: "… or every so many minutes, when there are new labels", kind: "number", value: now.round_every_minutes, min: 0, step: "any", required: true, hint: "0: never." },
        { name: "method", label: "Method", kind: "select", value: now.method, options: METHODS },
        { name: "publish_rule", label: "Publishing", kind: "select", value: now.publish_rule, options: RULES },
        { name: "evaluation_episodes", label: "Evaluation runs", kind: "number", value: now.evaluation_episodes, min: 10, max: 10000, step: 1, required: true },
        { name: "archived", label: "Campaign", kind: "select", value: String(before.archived), options: ARCHIVED, hint: "An archived campaign hands out no pairs and starts no rounds; nothing is deleted." },
      ],
      // Only what was edited: the criterion is fixed once there are labels, and what somebody else
      // has changed meanwhile is not to be changed back.
      onSubmit: ({ name, criterion, archived, ...given }) => {
        const changed = Object.fromEntries(Object.entries(given).filter(([key, value]) => value !== now[key]));
        const renamed = name === before.name ? {} : { name };
        const asked = criterion === plain(before.criterion) ? {} : { criterion };
        const moved = archived === String(before.archived) ? {} : { archived: archived === "true" };
        return request("PATCH", `/campaigns/${id}`, { body: { settings: changed, ...renamed, ...asked, ...moved } });
      },
    });
  };

  const nameOf = (checkpointId) =>
    data.checkpoints.find((item) => item.id === checkpointId)?.name ?? `Checkpoint ${checkpointId}`;

  const publish = (checkpointId) => {
    const name = nameOf(checkpointId);
    return confirmed(`${name} is published.`, {
      title: `Publish ${name}?`,
      text: "From now on runs are collected from it, and rounds start from it. It can be rolled back.",
      confirm: "Publish",
      fields: [REASON],
      onSubmit: ({ reason }) => post(`/campaigns/${id}/publish`, { checkpoint_id: checkpointId, reason }),
    });
  };

  const rollBack = async () => {
    // Asked for now: what the page knows may be older than the last move of somebody else.
    let checkpoint_id;
    try {
      ({ rollback_checkpoint_id: checkpoint_id } = await get(`/campaigns/${id}/stats`));
    } catch (error) {
      return toast(describe(error), { bad: true });
    }
    if (checkpoint_id === null) return toast("There is nothing to roll back to.", { bad: true });
    const name = nameOf(checkpoint_id);
    return confirmed(`Rolled back to ${name}.`, {
      title: `Roll back to ${name}?`,
      text: `Publishes ${name} again, which was published before. Nothing is deleted.`,
      confirm: "Roll back",
      danger: true,
      fields: [REASON],
      onSubmit: ({ reason }) => post(`/campaigns/${id}/rollback`, { checkpoint_id, reason }),
    });
  };

  const cancel = (round) => confirmed(`Round ${round.id} is cancelled.`, {
    title: `Cancel round ${round.id}?`,
    text: "The labels stay, and count as new again.",
    confirm: "Cancel round",
    dismiss: "Let it run",
    danger: true,
    onSubmit: () => post(`/rounds/${round.id}/cancel`),
  });

  const retry = async (job) => {
    try {
      await post(`/jobs/${job.id}/retry`);
      toast(`Job ${job.id} is queued again.`);
    } catch (error) {
      toast(describe(error), { bad: true, seconds: 12 });
    }
    refresh();
  };

  const lineage = async (checkpoint) => {
    try {
      show(`Lineage of ${checkpoint.name}`, lineageList(await get(`/checkpoints/${checkpoint.id}/lineage`)));
    } catch (error) {
      toast(describe(error), { bad: true, seconds: 12 });
    }
  };

  return { collect, startRound, settings, publish, rollBack, cancel, retry, lineage };
}
