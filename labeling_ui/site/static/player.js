// One replay of a pair in viser's client, driven by messages. See replay-adapter.js.
//
// Events (CustomEvent): "ready", "state", "key", "activity", "failed" (detail: {message, status})
// A failure is remembered in `failure`: a waiting replay fails before anybody listens.

import { cameraParameters, fitCamera } from "./camera.js";
import { PAGE_KEYS } from "./keys.js";

const READY_TIMEOUT_MS = 45_000; // software rendering on a busy machine takes seconds
export const SPEEDS = [0.5, 1, 2, 4];
const USUAL_STEP_S = 0.035; // a control step of most tasks, for a pair that tells none

export class Player extends EventTarget {
  constructor(holder, replayUrl, { view = "front", active = true, stepS = null } = {}) {
    super();
    this.stepS = stepS ?? USUAL_STEP_S; // seconds of one control step
    this.holder = holder;
    this.replayUrl = replayUrl;
    this.view = view;
    this.state = null;
    this.failure = null; // {message, status: of the server's answer, if there was one}
    this.frame = document.createElement("iframe");
    this.frame.title = "3D replay of run A and run B";
    this.frame.className = "replay";
    this.frame.allow = "fullscreen";
    this.setActive(active);
    this.listener = (event) => this.receive(event);
    window.addEventListener("message", this.listener);
    holder.append(this.frame);
    this.load(active);
  }

  // The file is fetched first: that tells a missing replay from a slow one, and warms the cache.
  async load(playing) {
    this.timer = setTimeout(
      () => this.fail("The replay did not start. Reload the page to try again."),
      READY_TIMEOUT_MS,
    );
    try {
      const answer = await fetch(this.replayUrl);
      if (!answer.ok) {
        this.fail(`The replay could not be loaded: the server said ${answer.status}.`, answer.status);
        return;
      }
      await answer.arrayBuffer();
    } catch (error) {
      this.fail(`The replay could not be loaded: ${error.message}.`);
      return;
    }
    if (this.closed) return;
    this.open(playing ? {} : { start: "paused" });
  }

  open(extra) {
    const camera = fitCamera(this.view, this.aspect());
    const query = new URLSearchParams({
      playbackPath: this.replayUrl,
      logCamera: "1",
      keys: JSON.stringify(PAGE_KEYS),
      ...cameraParameters(camera),
      ...extra,
    });
    const dpr = new URLSearchParams(location.search).get("fixedDpr");
    if (dpr) query.set("fixedDpr", dpr); // for machines that render in software
    this.frame.src = `/replay-client/?${query}`;
  }

  aspect() {
    const { width, height } = this.holder.getBoundingClientRect();
    return width > 0 && height > 0 ? width / height : 2;
  }

  receive(event) {
    if (event.origin !== location.origin || event.source !== this.frame.contentWindow) return;
    const message = event.data;
    if (message.kind === "replay-ready") {
      clearTimeout(this.timer);
      this.isReady = true;
      this.failure = null;
      this.emit("ready", message);
    } else if (message.kind === "replay-state") {
      this.state = message;
      this.emit("state", message);
    } else if (message.kind === "replay-key") {
      this.emit("key", message);
    } else if (message.kind === "replay-activity") {
      this.emit("activity", message);
    } else if (message.kind === "replay-error") {
      this.fail(message.message);
    } else if (message.kind === "replay-camera-refused") {
      this.open({});
    }
  }

  send(op, arg) {
    this.frame.contentWindow?.postMessage({ kind: "replay", op, arg }, location.origin);
  }

  setView(view) {
    this.view = view;
    this.send("camera", fitCamera(view, this.aspect()));
  }

  // A waiting player keeps its size, so that its picture is right when it comes on stage.
  setActive(active) {
    this.frame.classList.toggle("waiting", !active);
    this.frame.inert = !active;
    this.frame.setAttribute("aria-hidden", String(!active));
  }

  emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  fail(message, status = null) {
    clearTimeout(this.timer);
    if (this.closed || this.isReady) return;
    this.failure = { message, status };
    this.emit("failed", this.failure);
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    window.removeEventListener("message", this.listener);
    this.frame.remove();
  }
}

export function canDraw3d() {
  try {
    return document.createElement("canvas").getContext("webgl2") !== null;
  } catch {
    return false;
  }
}
