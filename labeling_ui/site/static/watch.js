// How long a pair was looked at, and what was played: stored with the label.

const IDLE_MS = 60_000; // without any input for this long, time no longer counts as active
const MAX_EVENTS = 300;

export class Watch {
  constructor(now = () => performance.now()) {
    this.now = now;
    this.started = now();
    this.activeMs = 0;
    this.last = this.started;
    this.lastInput = this.started;
    this.visible = document.visibilityState === "visible";
    this.events = [];
    this.replay = null;
    this.onVisibility = () => {
      this.count();
      this.visible = document.visibilityState === "visible";
      this.lastInput = this.now();
      this.record(this.visible ? "shown" : "hidden");
    };
    document.addEventListener("visibilitychange", this.onVisibility);
  }

  // Adds the time since the last count, up to the moment at which the annotator became idle.
  count() {
    const now = this.now();
    if (this.visible) this.activeMs += Math.max(0, Math.min(now, this.lastInput + IDLE_MS) - this.last);
    this.last = now;
  }

  input() {
    this.count();
    this.lastInput = this.now();
  }

  // {what, at: ms since the pair was shown, t: s in the replay, …}
  record(what, more = {}) {
    if (this.events.length >= MAX_EVENTS) return;
    const at = Math.round(this.now() - this.started);
    const t = this.replay ? Number(this.replay.t.toFixed(3)) : null;
    this.events.push({ what, at, t, ...more });
  }

  // Takes a state of the player and notes what changed: play, pause, looped, the camera.
  follow(state) {
    const before = this.replay;
    this.replay = state;
    if (!before) return;
    if (before.paused !== state.paused) this.record(state.paused ? "pause" : "play");
    if (!state.paused && state.t < before.t - 0.5) this.record("looped");
    if (before.speed !== state.speed) this.record("speed", { factor: state.speed });
    if (state.camera && before.camera && before.camera !== state.camera) this.noteCamera(state.camera);
  }

  // One event for a whole drag, with where it ended.
  noteCamera(camera) {
    const last = this.events.at(-1);
    if (last?.what === "camera") Object.assign(last, { camera });
    else this.record("camera", { camera });
  }

  summary() {
    this.count();
    return {
      duration_ms: Math.round(this.now() - this.started),
      active_ms: Math.round(this.activeMs),
      replay_events: this.events,
    };
  }

  close() {
    document.removeEventListener("visibilitychange", this.onVisibility);
  }
}
