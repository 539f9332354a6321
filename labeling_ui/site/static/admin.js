// The list of campaigns, and the dialog that makes a new one.

import { ApiError, get, post, signInAddress } from "./api.js";
import { ask, describe, element, enable, find, replace, toast } from "./dom.js";
import { count, words } from "./format.js";
import { addPerson, drawPeople } from "./people.js";

const box = find("#campaigns");
const archived = find("#archived");

async function load() {
  try {
    const campaigns = await get(`/campaigns?archived=${archived.checked}`);
    const cards = await Promise.all(campaigns.map(card));
    replace(box, cards.length > 0 ? cards : nothing());
    await drawPeople();
  } catch (error) {
    if (error instanceof ApiError && error.status === 401) location.assign(signInAddress());
    replace(box, element("p.form-error", { role: "alert" }, describe(error)));
  }
}

function nothing() {
  return element(
    "div.card.empty", {},
    element("strong", {}, "No campaign yet"), "Make one to collect runs and have them compared.",
  );
}

async function card(campaign) {
  const stats = await get(`/campaigns/${campaign.id}/stats`);
  const fact = (value, name) => element("span", {}, element("b", {}, count(value)), ` ${name}`);
  return element(
    "a.card.campaign-card", { href: `/admin/campaigns/${campaign.id}` },
    element("div.live-head", {}, element("h2", {}, campaign.name), element("span.pill", {}, words(campaign.task)),
      campaign.archived ? element("span.pill.warn", {}, "archived") : null),
    element("p.muted", {}, campaign.criterion),
    element(
      "div.facts", {},
      fact(stats.episodes, "runs"), fact(stats.pairs.ready, "pairs"), fact(stats.labels.effective, "labels"),
      stats.labels.new_since_round > 0 ? fact(stats.labels.new_since_round, "new since the last round") : null,
    ),
  );
}

// Policies of a task that a campaign can start from: the newest pretrained one first, as without a choice.
async function startPolicies(task) {
  const { id, name } = task.newest_checkpoint;
  const { items } = await get(`/checkpoints?task=${encodeURIComponent(task.name)}&limit=200`);
  const others = items.filter((one) => one.id !== id && !one.comparison);
  return [[id, `${name} (newest pretrained)`], ...others.map((one) => [one.id, one.name])];
}

async function create() {
  let tasks;
  let policies;
  try {
    tasks = await get("/tasks");
    policies = tasks.length > 0 ? await startPolicies(tasks[0]) : [];
  } catch (error) {
    toast(describe(error), { bad: true, seconds: 12 }); // the campaigns stay on the page
    return;
  }
  const made = {};
  // Another task proposes its own criterion, unless somebody has written one, and has other policies.
  const changeTask = async (name, form) => {
    const { criterion, start } = form.elements;
    const chosen = tasks.find((task) => task.name === name);
    if (tasks.some((task) => task.criterion === criterion.value)) criterion.value = chosen.criterion;
    const options = (pairs) => replace(start, pairs.map(([value, label]) => element("option", { value }, label)));
    const { id, name: newest } = chosen.newest_checkpoint;
    options([[id, `${newest} (newest pretrained)`]]); // at once: a policy of another task is refused
    const found = await startPolicies(chosen).catch(() => null); // the newest one can be had all the same
    if (found && form.elements.task.value === name) options(found);
  };
  const values = await ask({
    title: "New campaign",
    confirm: "Create",
    fields: [
      { name: "name", label: "Name", required: true, placeholder: "Avoid, left side" },
      { name: "task", label: "Robot task", kind: "select", options: tasks.map((task) => [task.name, words(task.name)]), onChange: changeTask },
      { name: "start", label: "Policy to start from", kind: "select", options: policies },
      { name: "criterion", label: "What annotators are asked", kind: "textarea", value: tasks[0]?.criterion ?? "", required: true },
      { name: "labels_per_pair", label: "Labels per pair", kind: "number", value: 1, min: 1, max: 20, step: 1, hint: "Two or more let the noise be measured from overlap." },
    ],
    onSubmit: async ({ name, task, start, criterion, labels_per_pair }) => {
      const settings = { labels_per_pair: labels_per_pair ?? 1 };
      made.campaign = await post("/campaigns", { name, task, criterion, settings, start_checkpoint_id: Number(start) });
    },
  });
  if (values) location.assign(`/admin/campaigns/${made.campaign.id}`);
}

archived.addEventListener("change", load);
find("#new-campaign").addEventListener("click", create);
find("#new-person").addEventListener("click", addPerson);
enable("#archived", "#new-campaign", "#new-person");
load();
