// Runs inside viser's playback client and gives it a message interface, because the client has none.
//
//   in   {kind: "replay", op, arg}
//          play | pause | toggle | restart | seek (s) | step (s, signed) | speed (0.5, 1, 2, 4)
//          camera ({position, lookAt} in metres of the recording)
//   out  {kind: "replay-ready", duration}
//        {kind: "replay-state", t, duration, paused, speed, camera}
//        {kind: "replay-key", code, key, shiftKey, repeat}     those of the URL's ?keys=["…", …] that
//                                                              are typed while the scene has focus
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

  // The client's own state is what it is told here and nothing else, so the page's last wish is the
  // truth: a toggle turns the wish round, not whatever a busy client happens to show at the moment.
  const RETRY_MS = 500;
  let wantPaused = parameters.get("start") === "paused";
  let sought = null; // s; where the last seek went, until the replay plays or is paused elsewhere
  let clicked = -RETRY_MS;
  const settle = () => {
    const now = performance.now();
    if (!bar() || paused() === wantPaused || now - clicked < RETRY_MS) return;
    clicked = now;
    playButton().click();
  };
  const setPaused = (wanted) => {
    wantPaused = wanted;
    sought = null;
    clicked = -RETRY_MS;
    settle();
  };

  // React keeps a component tree beside the page's elements.
  const fiberOf = (element, prefix) => {
    const key = element && Object.keys(element).find((name) => name.startsWith(prefix));
    return key ? element[key] : null;
  };

  // Through the slider's handler: the number field beside it rounds to 0.1 s, some frames later.
  // The client pauses when it seeks.
  const seek = (seconds) => {
    let fiber = fiberOf(slider(), "__reactFiber$");
    const seeks = (props) => typeof props?.onChange === "function" && props.max === duration();
    while (fiber && !seeks(fiber.memoizedProps)) fiber = fiber.return;
    if (!fiber) {
      post({ kind: "replay-error", message: "the replay cannot be moved in time" });
      return;
    }
    sought = Math.min(Math.max(seconds, 0), Math.max(duration() - 0.001, 0));
    fiber.memoizedProps.onChange(sought);
    wantPaused = true;
  };

  const restart = () => {
    seek(0);
    sought = null;
    wantPaused = false; // clicked as soon as the seek's own pause shows
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

  // The client keeps its viewer state in a React context.
  const findViewer = () => {
    for (const element of [document.getElementById("root"), ...document.body.children]) {
      const root = fiberOf(element, "__reactContainer$");
      const waiting = root ? [root] : [];
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
    toggle: () => setPaused(!wantPaused),
    restart,
    seek,
    step: (seconds) => seek((sought ?? time()) + seconds),
    speed: setSpeed,
    camera: moveCamera,
  };

  window.addEventListener("message", (event) => {
    if (event.origin !== location.origin || event.data?.kind !== "replay") return;
    const operation = operations[event.data.op];
    if (operation) operation(event.data.arg);
    else post({ kind: "replay-error", message: `unknown operation ${event.data.op}` });
  });

  // The keys that the page around the scene knows belong to it, wherever the focus is. The client
  // gets none; what the page does not know, such as F5, stays the browser's.
  const pageKeys = JSON.parse(parameters.get("keys") ?? "[]");
  window.addEventListener(
    "keydown",
    (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.key === "Tab") return;
      event.stopImmediatePropagation();
      const { code, key, shiftKey, repeat } = event;
      if (!pageKeys.includes(key.length === 1 ? key.toLowerCase() : key)) return;
      event.preventDefault();
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
    settle();
    if (!ready) {
      ready = true;
      if (wantPaused) seek(0); // before it plays or seeks, the client shows nothing of the recording
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
