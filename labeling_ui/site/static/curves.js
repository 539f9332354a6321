// Learning curves of a round, drawn by plotly.js from the installed package.

import { find } from "./dom.js";
import { stageWords } from "./format.js";

let library = null;

function loadPlotly() {
  library ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = "/vendor/plotly.min.js";
    script.addEventListener("load", () => resolve(window.Plotly));
    script.addEventListener("error", () => reject(new Error("the chart library did not load")));
    document.head.append(script);
  });
  return library;
}

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// `updates`: of the longest line; few of them are told apart by whole numbers.
function layout(title, updates, axis) {
  const line = css("--line");
  const font = { family: css("--font"), size: 12, color: css("--muted") };
  return {
    title: { text: title, font: { ...font, size: 14, color: css("--ink") }, x: 0, xref: "paper", xanchor: "left" },
    font, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 48, r: 12, t: 36, b: 72 },
    xaxis: { title: { text: "update", font, standoff: 8 }, dtick: updates <= 10 ? 1 : null, gridcolor: line, zerolinecolor: line, rangemode: "tozero" },
    yaxis: { gridcolor: line, zerolinecolor: line, rangemode: updates > 1 ? "normal" : "tozero", ...axis },
    showlegend: true,
    legend: { orientation: "h", x: 0, y: -0.26, yanchor: "top" },
    hovermode: "x unified",
  };
}

// Points of one stage become one line, in the order in which they came. `relative`: as a share of
// the line's first value, because the losses of different stages differ by orders of magnitude; one
// that begins below 0 (log-probabilities of densities) still falls as it gets better.
function traces(points, value, colours, { relative = false } = {}) {
  const stages = new Map();
  for (const point of points) {
    if (typeof point[value] !== "number") continue;
    if (!stages.has(point.stage)) stages.set(point.stage, []);
    stages.get(point.stage).push(point[value]);
  }
  return [...stages].map(([stage, values], index) => ({
    type: "scatter", mode: values.length > 1 ? "lines" : "markers", name: stageWords(stage),
    x: values.map((_, step) => step + 1),
    y: relative ? values.map((one) => one / Math.abs(values[0] || 1)) : values,
    text: values.map((one) => one.toPrecision(4)),
    hovertemplate: "%{text}",
    line: { width: 2, color: colours[index % colours.length] },
  }));
}

const longest = (lines) => Math.max(0, ...lines.map((line) => line.y.length));

// Returns whether there was anything to draw.
export async function drawCurves(points) {
  const colours = [css("--accent"), "#b07a1e", "#8a5fb0", "#5d7f3a", "#b3261e", "#56636f"];
  const losses = traces(points, "loss", colours, { relative: true });
  const votes = traces(points, "mean_vote", colours);
  if (losses.length === 0 && votes.length === 0) return false;
  const plotly = await loadPlotly();
  const options = { displayModeBar: false, responsive: true };
  const box = find("#vote-chart");
  box.hidden = votes.length === 0;
  await plotly.react(find("#loss-chart"), losses, layout("Loss, share of its first value", longest(losses), { tickformat: ".0%" }), options);
  if (votes.length > 0) {
    const title = "Mean vote for the labelled winner";
    await plotly.react(box, votes, layout(title, longest(votes), { tickformat: ".1%" }), options);
  }
  return true;
}
