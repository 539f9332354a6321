// What stands on the stage of the annotator's page when there is no replay to see.

import { signInAddress } from "./api.js";
import { element, find, replace } from "./dom.js";

const box = find("#stage-note");

function set(...children) {
  box.className = "stage-note veil";
  replace(box, children);
}

export const shown = () => box.textContent !== "";

export function clear() {
  box.className = "stage-note";
  replace(box);
}

const spinner = () => element("div.spinner", { "aria-hidden": "true" });
const button = (label, action) => element("button.button", { type: "button", onclick: action }, label);

export function loading(text) {
  set(spinner(), element("p", {}, `${text}…`));
}

// `judged`: how many pairs were judged on this page; `undo` takes the last one back.
export function nothing(reason, judged, undo) {
  const thanks = judged > 0 ? ` You judged ${judged} ${judged === 1 ? "pair" : "pairs"} here. Thank you.` : "";
  const [title, text] = {
    replays_waiting: ["The next replays are being made", "This page shows them as soon as they are ready."],
    all_done: ["All done", `There is no pair left for you.${thanks}`],
    no_pairs: ["Nothing to label yet", "No runs have been collected for this campaign so far."],
  }[reason] ?? ["Nothing to label", "Come back later."];
  set(
    reason === "replays_waiting" ? spinner() : null,
    element("h2", {}, title), element("p", {}, text),
    judged > 0 ? button("Undo the last answer (Z)", undo) : null,
  );
}

export function signedOut() {
  set(element("h2", {}, "You are signed out"), element("a.button", { href: signInAddress() }, "Sign in"));
}

export function offline(retry) {
  const text = "Your answers are safe on this device. This page goes on by itself when the server answers.";
  set(element("h2", {}, "No connection to the server"), element("p", {}, text), button("Try now", retry));
}

export function busy(text, retry) {
  set(
    element("h2", {}, "The server cannot take answers now"),
    element("p", {}, `Your answers are safe on this device. This page goes on by itself. (${text})`),
    button("Try now", retry),
  );
}

export function problem(title, text, retry) {
  set(element("h2", {}, title), element("p", {}, text), button("Try again", retry));
}

export function failedReplay(text, { retry, skip, skipLabel }) {
  set(
    element("h2", {}, "The replay is not there"), element("p", {}, text),
    element("div.note-actions", {}, button("Try again", retry), button(skipLabel, skip)),
  );
}
