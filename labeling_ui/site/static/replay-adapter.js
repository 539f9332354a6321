// Runs inside viser's playback client and gives it a message interface, because the client has none.
//
//   in   {kind: "replay", op, arg}
//          play | pause | toggle | restart | seek (s) | step (s, signed) | speed (0.5, 1, 2, 4)
//          camera ({position, lookAt} in metres of the recording)
//   out  {kind: "replay-ready", duration}
//        {kind: "replay-state", t, duration, paused, speed, camera}
//        {kind: "replay-key", code, key, shiftKey, repeat}     keys typed while the scene has focus
//        {kind: "replay-activity"}                             the pointer is at work in the scene
//        {kind: "replay-error", message}
//        {kind: "replay-camera-refused", arg}                  load the page anew with this camera
//
// What it touches of the client is no published interface. All of it is in this file, and a browser
// test holds it against the installed client.
(() => {
  const parentWindow = window.parent;
  if (parentWindow === window) return;
  const post = (message) => parentWindow.postMessage(message, location.origin);
  const parameters = new URLSearchParams(location.search);

  const style = document.createElement("style");
  style.textContent = `
    html, body { background: transparent; }
    canvas { opacity: 1 !important; }
    .mantine-Notifications-root, [data-playback-scene-tree] { display: none !important; }
    .mantine-Paper-root:has([role="slider"]) {
      position: fixed !important; left: 0; bottom: 0; opacity: 0; pointer-events: none;
    }
    .mantine-Popover-dropdown, .mantine-Select-dropdown { opacity: 0 !important; }
  `;
  document.documentElement.append(style);

  // ---- the client's hidden transport bar ---------------------------------------------------

  const slider = () => document.querySelector("[role=slider]");
  const bar = () => slider()?.closest(".mantine-Paper-root") ?? null;
  const inputs = () => bar()?.querySelectorAll("input:not([type=hidden])") ?? [];
  const playButton = () => bar()?.querySelector("button") ?? null;
  const paused = () => playButton()?.querySelector(".tabler-icon-player-play-filled") !== null;
  const time = () => Number(slider()?.getAttribute("aria-valuenow") ?? 0);
  const duration = () => Number(slider()?.getAttribute("aria-valuemax") ?? 0);

  // What the page asked for last. The client applies a click or a seek some frames later, on a busy
  // machine seconds later: one click can be swallowed, and a second one too early undoes the first.
  const SETTLE_MS = 3000;
  let asked = 0;
  const setPaused = (wanted) => {
    asked += 1;
    const mine = asked;
    const started = performance.now();
    let clicked = -SETTLE_MS;
    const look = () => {
      const now = performance.now();
      if (mine !== asked || now - started > 4 * SETTLE_MS) return;
      if (bar() && paused() !== wanted && now - clicked >= SETTLE_MS) {
        clicked = now;
        playButton().click();
      }
      // A seek that is still on its way may pause again for a moment after it looked right.
      if (now - started < 1000 || paused() !== wanted) setTimeout(look, 60);
    };
    look();
  };

  // React listens to the native setter only through a bubbling input event. Seeking pauses.
  const seek = (seconds) => {
    const input = inputs()[0];
    if (!input) return;
    const value = Math.min(Math.max(seconds, 0), Math.max(duration() - 0.001, 0));
    const setter = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
    setter.call(input, value.toFixed(4));
    input.dispatchEvent(new Event("input", { bubbles: true }));
  };

  const restart = () => {
    seek(0);
    setPaused(false);
  };

  const setSpeed = async (factor) => {
    const input = inputs()[1];
    const wanted = `${factor}x`;
    if (!input || input.value === wanted) return;
    input.click();
    for (let attempt = 0; attempt < 40; attempt += 1) {
      const options = [...document.querySelectorAll("[role=option]")];
      const option = options.find((item) => item.textContent.trim() === wanted);
      if (option) {
        option.click();
        document.activeElement?.blur();
        return;
      }
      await new Promise((resolve) => setTimeout(resolve, 25));
    }
    post({ kind: "replay-error", message: `no speed ${wanted}` });
  };

  // ---- camera ------------------------------------------------------------------------------

  // With ?logCamera the client prints its camera as URL parameters whenever it moves.
  let camera = "";
  const log = console.log.bind(console);
  console.log = (...parts) => {
    if (typeof parts[0] === "string" && parts[0].startsWith("&initialCamera")) {
      camera = parts[0];
      return;
    }
    log(...parts);
  };

  // The client keeps its viewer state in a React context; walk the component tree to it.
  const findViewer = () => {
    for (const element of [document.getElementById("root"), ...document.body.children]) {
      const key = element && Object.keys(element).find((name) => name.startsWith("__reactContainer$"));
      if (!key) continue;
      const waiting = [element[key]];
      while (waiting.length > 0) {
        const fiber = waiting.pop();
        const viewer = fiber.memoizedProps?.value;
        if (viewer?.mutable?.current?.cameraControl) return viewer;
        if (fiber.sibling) waiting.push(fiber.sibling);
        if (fiber.child) waiting.push(fiber.child);
      }
    }
    return null;
  };

  // v + 2w (u × v) + 2u × (u × v), with the quaternion (w, u) of the recording's world frame.
  const rotate = ([w, ...u], v) => {
    const cross = (a, b) => [0, 1, 2].map((i) => {
      const [j, k] = [(i + 1) % 3, (i + 2) % 3];
      return a[j] * b[k] - a[k] * b[j];
    });
    const once = cross(u, v);
    const twice = cross(u, once);
    return v.map((value, i) => value + 2 * (w * once[i] + twice[i]));
  };

  const moveCamera = (view) => {
    const viewer = findViewer();
    const controls = viewer?.mutable.current.cameraControl;
    const world = viewer?.useSceneTree?.get?.("")?.wxyz;
    if (!world || typeof controls?.setLookAt !== "function") {
      post({ kind: "replay-camera-refused", arg: view });
      return;
    }
    const smooth = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    controls.setLookAt(...rotate(world, view.position), ...rotate(world, view.lookAt), smooth);
  };

  // ---- messages ----------------------------------------------------------------------------

  const operations = {
    play: () => setPaused(false),
    pause: () => setPaused(true),
    toggle: () => setPaused(!paused()),
    restart,
    seek: (seconds) => {
      asked += 1; // a seek pauses: an earlier wish to play is over
      seek(seconds);
    },
    step: (seconds) => operations.seek(time() + seconds),
    speed: setSpeed,
    camera: moveCamera,
  };

  window.addEventListener("message", (event) => {
    if (event.origin !== location.origin || event.data?.kind !== "replay") return;
    const operation = operations[event.data.op];
    if (operation) operation(event.data.arg);
    else post({ kind: "replay-error", message: `unknown operation ${event.data.op}` });
  });

  // Keys belong to the page around the scene, wherever the focus is.
  window.addEventListener(
    "keydown",
    (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.key === "Tab") return;
      event.stopImmediatePropagation();
      event.preventDefault();
      const { code, key, shiftKey, repeat } = event;
      post({ kind: "replay-key", code, key, shiftKey, repeat });
    },
    true,
  );

  let lastActivity = 0;
  const active = () => {
    const now = performance.now();
    if (now - lastActivity < 500) return;
    lastActivity = now;
    post({ kind: "replay-activity" });
  };
  window.addEventListener("pointerdown", active, true);
  window.addEventListener("wheel", active, { capture: true, passive: true });

  window.addEventListener("unhandledrejection", (event) => {
    if (!bar()) post({ kind: "replay-error", message: String(event.reason) });
  });

  // ---- state -------------------------------------------------------------------------------

  let ready = false;
  let posted = "";
  setInterval(() => {
    if (!slider()) return;
    if (!ready) {
      ready = true;
      if (parameters.get("start") === "paused") setPaused(true);
      post({ kind: "replay-ready", duration: duration() });
    }
    const state = {
      kind: "replay-state",
      t: time(),
      duration: duration(),
      paused: paused(),
      speed: Number.parseFloat(inputs()[1]?.value ?? "1"),
      camera,
    };
    const text = JSON.stringify(state);
    if (text !== posted) {
      posted = text;
      post(state);
    }
  }, 50);
})();
