// What a round changed: rates with their 95 % intervals, and the paths seen from above.

import { element, svg } from "./dom.js";
import { interval, percent, words } from "./format.js";

const MEASURES = [
  { key: "success", name: "Success", better: 1 },
  { key: "alignment", name: "Mode alignment, all runs", better: 1 },
  { key: "alignment_of_successes", name: "Mode alignment, successful runs", better: 1 },
  { key: "off_support", name: "Off the data", better: -1 },
];

export function measures(before, after) {
  return MEASURES.map(({ key, name, better }) => {
    return element(
      "div.measure", {},
      element(
        "div.measure-head", {}, element("h3", {}, name),
        after ? changeText(before, after, key, better) : null,
      ),
      barRow("before", before, key), after ? barRow("after", after, key) : null,
    );
  });
}

// Coloured only when the two 95 % intervals do not overlap: the rest may be chance.
function changeText(before, after, key, better) {
  const points = Math.round(100 * (after[key] - before[key]));
  const [one, other] = [before.intervals?.[key], after.intervals?.[key]];
  const clear = one && other && (one[1] < other[0] || other[1] < one[0]);
  const look = !clear ? "" : points * better > 0 ? ".up" : ".down";
  const sign = points > 0 ? "+" : points < 0 ? "−" : "±";
  const noun = Math.abs(points) === 1 ? "point" : "points";
  return element(`span.change${look}`, {}, `${sign}${Math.abs(points)} ${noun}`);
}

function barRow(name, evaluation, key) {
  const rate = evaluation[key] ?? 0;
  const range = evaluation.intervals?.[key];
  const whisker = range
    ? element("div.whisker", { style: `left:${100 * range[0]}%;width:${100 * (range[1] - range[0])}%` })
    : null;
  const title = range ? `95 % interval ${interval(range)} %, n = ${evaluation.n}` : `n = ${evaluation.n}`;
  return element(
    `div.bar-row.${name}`, { title },
    element("span", {}, name),
    element("div.bar-back", {}, element("div.bar-fill", { style: `width:${100 * rate}%` }), whisker),
    element("span", {}, element("b", {}, percent(rate)), range ? ` ${interval(range)}` : ""),
  );
}

// Groups keep their colour on every map: the preferred one in the accent colour, failures in red.
const OTHER_GROUPS = ["#b07a1e", "#8a5fb0", "#5d7f3a", "#7a6a5a", "#c2588f"]; // as many as any task has

export function groupColour(group, facts) {
  if (group === "failed") return "var(--bad)";
  if (group === facts.preferred_group) return "var(--accent)";
  const others = (facts.groups ?? []).filter((name) => name !== facts.preferred_group);
  return OTHER_GROUPS[Math.max(0, others.indexOf(group))];
}

const MARGIN = 0.03; // m around the work space

// Top-down map of paths [[x, y], …] in metres: x to the right, y up.
export function pathMap(title, evaluation, facts) {
  const box = facts.scene.find((shape) => shape.type === "workspace");
  const [x0, x1] = [box.x0 - MARGIN, box.x1 + MARGIN];
  const [y0, y1] = [box.y0 - MARGIN, box.y1 + 2 * MARGIN];
  const paths = (evaluation?.paths ?? []).map((points, index) => {
    const group = evaluation.path_groups?.[index] ?? "none";
    const line = points.map(([x, y]) => `${x.toFixed(4)},${(-y).toFixed(4)}`).join(" ");
    return svg("polyline", {
      points: line, fill: "none", stroke: groupColour(group, facts), "data-group": group,
      "stroke-width": 0.004, "stroke-opacity": 0.5, "stroke-linejoin": "round", "stroke-linecap": "round",
    });
  });
  const picture = svg(
    "svg",
    { viewBox: `${x0} ${-y1} ${x1 - x0} ${y1 - y0}`, role: "img", "aria-label": `${title}: ${paths.length} paths seen from above` },
    [...facts.scene].sort(groundFirst).map(sceneShape), paths,
  );
  const caption = evaluation ? `${title} · ${paths.length} of ${evaluation.n} runs` : title;
  return element("figure", {}, element("figcaption", {}, caption), picture);
}

const GROUND = ["workspace", "platform", "target"];
const groundFirst = (one, other) => GROUND.includes(other.type) - GROUND.includes(one.type);

function sceneShape(shape) {
  if (shape.type === "cylinder") {
    return svg("circle", { cx: shape.x, cy: -shape.y, r: shape.radius, fill: shape.colour });
  }
  if (shape.type === "finish") {
    const line = { x1: shape.x0, x2: shape.x1, y1: -shape.y, y2: -shape.y };
    return svg("line", { ...line, stroke: shape.colour, "stroke-width": 0.008 });
  }
  if (shape.type === "workspace") {
    const size = { width: shape.x1 - shape.x0, height: shape.y1 - shape.y0 };
    return svg("rect", { x: shape.x0, y: -shape.y1, ...size, fill: "none", stroke: "var(--line)", "stroke-width": 0.003 });
  }
  if (shape.type === "platform") {
    const size = { width: shape.x1 - shape.x0, height: shape.y1 - shape.y0 };
    return svg("rect", { x: shape.x0, y: -shape.y1, ...size, fill: "var(--line)", "fill-opacity": 0.4 });
  }
  if (shape.type === "target") {
    const size = { width: 2 * shape.half_x, height: 2 * shape.half_y };
    return svg("rect", {
      x: shape.x - shape.half_x, y: -shape.y - shape.half_y, ...size,
      fill: shape.colour, "fill-opacity": 0.15, stroke: shape.colour, "stroke-width": 0.003,
    });
  }
  if (shape.type === "cube") { // somewhere in its start range, so only an outline
    return svg("rect", {
      x: shape.x - shape.half_x, y: -shape.y - shape.half_y, width: 2 * shape.half_x, height: 2 * shape.half_y,
      fill: "none", stroke: shape.colour, "stroke-width": 0.004, "stroke-dasharray": "0.012 0.008",
    });
  }
  if (shape.type === "start") {
    return svg("circle", { cx: shape.x, cy: -shape.y, r: 0.009, fill: "none", stroke: "var(--muted)", "stroke-width": 0.003 });
  }
  return null;
}

export function legend(evaluations, facts) {
  const groups = new Set();
  for (const evaluation of evaluations) for (const group of evaluation?.path_groups ?? []) groups.add(group);
  const order = [facts.preferred_group, ...(facts.groups ?? []), "none", "failed"];
  const sorted = [...groups].sort((one, other) => order.indexOf(one) - order.indexOf(other));
  return element(
    "div.legend", {},
    sorted.map((group) => element(
      "span", {}, element("i", { style: `background:${groupColour(group, facts)}` }),
      group === facts.preferred_group ? `${words(group)} (preferred)` : words(group),
    )),
  );
}

// What the gate of a round said, and what became of the candidate where that is not plain.
export function gate(round) {
  const verdict = round?.result?.gate;
  if (!verdict) return null;
  const title = verdict.passed ? "The gate passed" : "The gate refused";
  return element(
    "div.gate", {},
    element("strong", {}, title), round.state === "kept" ? ` · ${whyKept(round)}` : "",
    element("ul", {}, verdict.reasons.map((reason) => element("li", {}, reason))),
    round.stopped ? element("p.muted.small", {}, `Fine-tuning: ${round.stopped}`) : null,
  );
}

function whyKept({ publish_rule, result }) {
  if (publish_rule === "never") return "for comparison, never published";
  return result.gate.unchanged ? "not published, nothing was learned" : "kept for an admin to publish";
}
