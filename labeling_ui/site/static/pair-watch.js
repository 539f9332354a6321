// A pair as annotators see it, for admins: the replay, what really happened, and who answered what.

import { get, getAll } from "./api.js";
import { describe, element, find, replace } from "./dom.js";
import { CHOICES, duration, moment, words } from "./format.js";
import { commandOf, isOwn } from "./keys.js";
import { table } from "./panels.js";
import { Player, canDraw3d } from "./player.js";
import { Transport } from "./transport.js";

const dialog = find("#watch-pair");
const note = find("#stage-note");
const transport = new Transport();
const has3d = canDraw3d();
let player = null;
let shown = null; // the pair's id; what is fetched for another one comes too late

dialog.addEventListener("close", () => {
  player?.close();
  player = shown = null;
  transport.attach(null);
});
dialog.addEventListener("keydown", (event) => {
  const command = transport.commands[commandOf(event)];
  if (!command || isOwn(event)) return;
  event.preventDefault();
  command();
});

// names: of accounts by their ids
export async function watchPair(pair, names) {
  shown = pair.id;
  find("h2", dialog).textContent = `Pair ${pair.id}: ${words(pair.reason)}`;
  for (const part of ["#watch-runs", "#watch-answers"]) replace(find(part));
  dialog.showModal();
  play(pair);
  try {
    const [episodes, answers] = await Promise.all([
      get(`/pairs/${pair.id}/episodes`),
      getAll(`/campaigns/${pair.campaign_id}/labels?pair_id=${pair.id}`),
    ]);
    if (shown !== pair.id) return;
    replace(find("#watch-runs"), runsTable(episodes));
    replace(find("#watch-answers"), answersTable(answers, pair, names));
  } catch (error) {
    if (shown === pair.id) replace(find("#watch-runs"), element("p.form-error", { role: "alert" }, describe(error)));
  }
}

function play(pair) {
  if (!pair.replay_url || !has3d) {
    const picture = pair.thumbnail_url && element("img.poster", { src: pair.thumbnail_url, alt: `Paths of pair ${pair.id}` });
    const why = has3d ? "Its replay is not made yet." : "This browser cannot draw 3D.";
    replace(note, picture || element("p", {}, why));
    return;
  }
  replace(note, element("div.spinner", { "aria-hidden": "true" }), element("p", {}, "Loading the replay"));
  const mine = new Player(find("#stage"), pair.replay_url, { view: transport.view });
  player = mine;
  const whenShown = (name, action) =>
    mine.addEventListener(name, ({ detail }) => { if (player === mine) action(detail); });
  whenShown("ready", () => {
    replace(note);
    transport.attach(mine);
    transport.begin();
  });
  whenShown("state", (state) => transport.show(state));
  whenShown("key", (message) => transport.commands[commandOf(message)]?.());
  whenShown("failed", ({ message }) => replace(note, element("p", {}, message)));
}

function runsTable({ first, second, first_is_left: firstIsLeft }) {
  const sides = firstIsLeft ? [["A", first], ["B", second]] : [["A", second], ["B", first]];
  const heads = [["Run"], ["Ended"], ["Mode"], ["Group"], ["Steps", "number"], ["Episode", "number"], ["Policy", "number"]];
  return table(heads, sides.map(([side, episode]) => element(
    "tr", {},
    element("td", {}, side),
    element("td", {}, episode.success ? "success" : words(episode.outcome.reason)),
    element("td", {}, episode.mode ?? "–"),
    element("td", {}, episode.group ?? "–"),
    element("td.number", {}, String(episode.steps)),
    element("td.number", {}, String(episode.id)),
    element("td.number", {}, String(episode.checkpoint_id)),
  )));
}

// Stored answers name an episode; the page tells the side that it was on.
function sideOf(choice, { first_is_left: firstIsLeft }) {
  if (choice === "first") return firstIsLeft ? "left" : "right";
  if (choice === "second") return firstIsLeft ? "right" : "left";
  return choice;
}

function answersTable(answers, pair, names) {
  const heads = [["Annotator"], ["Answer"], ["Looked for", "number"], ["When"], ["In force"]];
  return table(heads, answers.map((answer) => element(
    "tr", {},
    element("td", {}, names[answer.annotator_id] ?? `account ${answer.annotator_id}`),
    element("td", {}, answer.retracted ? "taken back" : CHOICES[sideOf(answer.choice, pair)]),
    element("td.number", {}, duration(answer.active_ms ?? answer.duration_ms)),
    element("td", {}, moment(answer.created_at)),
    element("td", {}, answer.in_force ? "yes" : "no"),
  )), "Nobody has answered this pair yet.");
}
