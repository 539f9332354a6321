// The transport bar and the camera buttons: they show and drive whichever player is on stage.

import { find, findAll } from "./dom.js";
import { SPEEDS } from "./player.js";

export class Transport {
  constructor() {
    this.bar = find("#transport");
    this.scrubber = find("#scrubber");
    this.clock = find("#clock");
    this.speed = find("#speed");
    this.views = find("#views");
    this.player = null;
    this.view = "front";
    this.onUse = () => {};
    this.commands = { // by their names in keys.js
      toggle: () => this.toggle(),
      restart: () => this.restart(),
      back: () => this.step(-1),
      on: () => this.step(1),
      slower: () => this.changeSpeed(-1),
      faster: () => this.changeSpeed(1),
      front: () => this.setView("front"),
      top: () => this.setView("top"),
      low: () => this.setView("low"),
    };
    find("#play").addEventListener("click", () => this.toggle());
    find("#restart").addEventListener("click", () => this.restart());
    find("#back").addEventListener("click", () => this.step(-1));
    find("#forward").addEventListener("click", () => this.step(1));
    this.scrubber.addEventListener("pointerdown", () => { this.dragging = true; });
    this.scrubber.addEventListener("pointerup", () => {
      this.dragging = false;
      this.scrubber.blur(); // after a mouse drag the arrow keys judge; whoever tabs here seeks with them
    });
    this.scrubber.addEventListener("change", () => { this.dragging = false; });
    this.scrubber.addEventListener("input", () => this.seek(Number(this.scrubber.value)));
    this.speed.addEventListener("change", () => this.setSpeed(Number(this.speed.value)));
    for (const button of findAll("button", this.views)) {
      button.addEventListener("click", () => this.setView(button.dataset.view));
    }
    this.attach(null);
  }

  attach(player) {
    this.player = player;
    this.bar.classList.toggle("off", player === null);
    this.views.hidden = player === null;
    if (player?.state) this.show(player.state);
  }

  // A new pair on stage: at normal speed, from the start.
  begin() {
    this.speed.value = "1";
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) this.player?.send("pause");
    else this.player?.send("play");
  }

  show(state) {
    this.bar.classList.toggle("playing", !state.paused);
    find("#play").setAttribute("aria-label", state.paused ? "Play" : "Pause");
    this.scrubber.max = state.duration;
    if (!this.dragging) this.scrubber.value = state.t;
    this.scrubber.setAttribute("aria-valuetext", `${state.t.toFixed(1)} of ${state.duration.toFixed(1)} seconds`);
    this.clock.textContent = `${state.t.toFixed(1)} / ${state.duration.toFixed(1)} s`;
    if (document.activeElement !== this.speed) this.speed.value = String(state.speed);
  }

  send(op, arg, note = {}) {
    if (!this.player) return;
    this.player.send(op, arg);
    this.onUse(op, note);
  }

  toggle() { this.send("toggle"); }
  restart() { this.send("restart"); }
  step(direction) { this.send("step", direction * (this.player?.stepS ?? 0), { frames: direction }); }
  seek(seconds) { this.send("seek", seconds, { to: seconds }); }
  setSpeed(factor) { this.send("speed", factor, { factor }); }

  changeSpeed(direction) {
    const index = SPEEDS.indexOf(Number(this.speed.value)) + direction;
    const factor = SPEEDS[Math.min(Math.max(index, 0), SPEEDS.length - 1)];
    this.speed.value = String(factor);
    this.setSpeed(factor);
  }

  setView(view) {
    this.view = view;
    for (const button of findAll("button", this.views)) {
      button.setAttribute("aria-pressed", String(button.dataset.view === view));
    }
    this.player?.setView(view);
    this.onUse("view", { view });
  }
}
