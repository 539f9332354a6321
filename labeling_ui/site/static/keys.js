// The keys of the annotator's page: what each of them asks for, and where they mean something else.

import { find } from "./dom.js";

const COMMANDS = {
  ArrowLeft: "left", ArrowRight: "right", ArrowUp: "equal", ArrowDown: "cannot_tell",
  z: "undo", Backspace: "undo",
  " ": "toggle", r: "restart", ",": "back", ".": "on", "[": "slower", "]": "faster",
  1: "front", 2: "top", 3: "low",
  "?": "help",
};
const REPEATED = ["back", "on"]; // while the key is held down
export const PAGE_KEYS = Object.keys(COMMANDS);

// What a key asks for, if anything.
export const commandOf = ({ key }) => COMMANDS[key.length === 1 ? key.toLowerCase() : key];

// Calls `run(command)` for keys typed on the page. Returns a function that takes what the replay
// tells of keys typed in the scene.
export function listenToKeys(run) {
  const press = ({ key, repeat }) => {
    const command = commandOf({ key });
    if (command && (!repeat || REPEATED.includes(command))) run(command);
    return command !== undefined;
  };
  document.addEventListener("keydown", (event) => {
    if (!isTaken(event) && press(event)) event.preventDefault();
  });
  // After a mouse click the keys are for the replay again; whoever tabs to a control stays there.
  document.addEventListener("click", (event) => {
    if (event.detail > 0) event.target.closest("button, summary")?.blur();
  }, true);
  return (message) => { if (!isCovered()) press(message); };
}

const isCovered = () => find("dialog[open], .menu[open]") !== null;

function isTaken(event) {
  return isCovered() || event.target.closest(".bar, .banner, .criterion, .toast") !== null || isOwn(event);
}

// Whether the key belongs to the control that has the focus, or to the browser.
export function isOwn({ target, key, ctrlKey, metaKey, altKey }) {
  if (ctrlKey || metaKey || altKey) return true;
  if (target.closest("select, textarea, input:not([type=range])")) return true;
  if (key === " ") return target.closest("a, button, summary") !== null;
  return target.matches("input") && key.startsWith("Arrow");
}
