// What the campaign page knows, fetched part by part: an event names the parts that it changes.

import { get } from "./api.js";

const PAIRS_AT_ONCE = 24;
const ROWS_AT_ONCE = 50; // of rounds and of checkpoints
const JOBS_AT_ONCE = 20; // of each of these states, what runs first: however much has failed, it is seen
const JOB_STATES = ["running", "failed", "queued"];

export const PARTS = ["campaign", "stats", "rounds", "jobs", "checkpoints", "pairs", "curves"];

const OF_EVENT = {
  state: ["rounds", "jobs", "checkpoints", "stats"],
  curve: ["curves"],
  label: ["stats"],
  release: ["stats"],
  publication: ["campaign", "checkpoints", "stats"],
};
// What else a job changes when it ends; everything it does to a round comes as "state".
const OF_ENDED_JOB = { collect: ["pairs"], replay: ["pairs"], evaluate: ["rounds"], publish: ["rounds"] };

export function campaignData(id) {
  const data = {
    campaign: null, stats: null, rounds: [], jobs: [], checkpoints: [], published: null, pairs: [],
    cursors: { rounds: null, checkpoints: null, pairs: null },
  };
  const paths = {
    rounds: () => `/campaigns/${id}/rounds?limit=${ROWS_AT_ONCE}`,
    checkpoints: () => `/checkpoints?task=${encodeURIComponent(data.campaign.task)}&limit=${ROWS_AT_ONCE}`,
    pairs: () => `/campaigns/${id}/pairs?limit=${PAIRS_AT_ONCE}`,
  };

  // Puts the newest page before what older pages have brought.
  const loadNewest = async (name) => {
    const page = await get(paths[name]());
    const last = page.items.at(-1)?.id ?? 0;
    const older = data[name].filter((row) => row.id < last);
    data[name] = [...page.items, ...older];
    if (older.length === 0) data.cursors[name] = page.next_cursor;
  };

  const loaders = {
    campaign: async () => { data.campaign = await get(`/campaigns/${id}`); },
    stats: async () => { data.stats = await get(`/campaigns/${id}/stats`); },
    rounds: () => loadNewest("rounds"),
    jobs: async () => {
      const path = (state) => `/jobs?campaign_id=${id}&state=${state}&limit=${JOBS_AT_ONCE}`;
      data.jobs = (await Promise.all(JOB_STATES.map((state) => get(path(state))))).flat();
    },
    checkpoints: async () => {
      await loadNewest("checkpoints");
      const wanted = data.campaign.published_checkpoint_id;
      data.published = data.checkpoints.find((item) => item.id === wanted)
        ?? (data.published?.id === wanted ? data.published : await get(`/checkpoints/${wanted}`));
    },
    pairs: async () => {
      if (data.pairs.length > PAIRS_AT_ONCE) return; // somebody looks at more of them
      const page = await get(paths.pairs());
      data.pairs = page.items;
      data.cursors.pairs = page.next_cursor;
    },
    curves: async () => {}, // of the round that is shown: the page fetches them
  };

  const load = async (parts) => {
    const rest = parts.filter((part) => part !== "campaign");
    if (!data.campaign || rest.length < parts.length) await loaders.campaign(); // others go by it
    await Promise.all(rest.map((part) => loaders[part]()));
  };

  const loadMore = async (name) => {
    const page = await get(`${paths[name]()}&cursor=${data.cursors[name]}`);
    data[name] = [...data[name], ...page.items];
    data.cursors[name] = page.next_cursor;
  };

  // The parts to fetch after an event. Progress of a job that is on the page is noted at once.
  const changedBy = (name, told) => {
    if (name !== "progress") return OF_EVENT[name];
    const job = data.jobs.find((item) => item.id === told.job_id);
    const ended = Boolean(told.state) || told.stage === "done";
    if (ended) return ["jobs", "stats", ...(OF_ENDED_JOB[told.kind] ?? [])];
    if (job?.state !== "running") return ["jobs", "stats"];
    Object.assign(job, { progress: told.progress, stage: told.stage });
    return [];
  };

  return { data, load, loadMore, changedBy, events: ["progress", ...Object.keys(OF_EVENT)] };
}
