// The panel of a motion: figures, what was passed, phases, and small charts.

const UNNAMED = "#8a93a5"; // of more curves than colours those that change most are named

const TALL = 62, LOW = 48; // heights of a plot where there is room, and at least

function makeReadouts(parent, readouts) {
  if (!readouts.length) return () => {};
  const grid = document.createElement("div");
  grid.className = "readouts";
  const shows = readouts.map((each) => {
    const name = document.createElement("span"), value = document.createElement("b");
    name.textContent = each.label;
    grid.append(name, value);
    return (i) => { value.textContent = `${figure(each.values[i], 3)} ${each.unit}`.trim(); };
  });
  parent.append(grid);
  return (i) => shows.forEach((show) => show(i));
}

// One mark for the quantities that the simulation must conserve.
function makeConserved(parent, { holds, text, details }) {
  parent.append(element("div", { className: holds ? "conserved" : "conserved lost", title: details }, `${holds ? "✓" : "✗"} ${text}`));
}

// What went beyond its limit: the worst of it, which leads to its time; all of it on hovering.
function makePassed(parent, passed, seek) {
  if (!passed.length) return;
  const line = document.createElement("button");
  line.className = "passed";
  line.textContent = `limit exceeded${passed.length > 1 ? `, worst of ${passed.length}` : ""}:\n${passed[0][0]}`;
  line.title = passed.map(([text]) => text).join("\n");
  line.addEventListener("click", () => seek(passed[0][1]));
  parent.append(line);
}

// The phases of a motion, which lead to their times. Returns what shows and tells the one at a time.
function makePhases(parent, phases, seek) {
  if (!phases.length) return () => "";
  const list = document.createElement("div");
  list.className = "phases";
  const rows = phases.map(([name, start]) => {
    const row = document.createElement("button"), at = document.createElement("span");
    at.textContent = `${Number(start.toPrecision(4))} s`;
    row.append(name, at);
    row.addEventListener("click", () => seek(start));
    list.append(row);
    return row;
  });
  parent.append(list);
  return (time) => {
    const now = phases.reduce((last, [, start], k) => (start <= time ? k : last), 0);
    rows.forEach((row, k) => row.setAttribute("aria-pressed", k === now));
    document.querySelector("h1").textContent = phases[now][2]; // what then flies
    document.querySelector("header p").textContent = phases[now][3];
    return `, ${phases[now][0]}`;
  };
}

// Where the time of the plots begins and ends.
function makeSpan(parent, t) {
  const row = document.createElement("div");
  row.className = "span";
  for (const time of [t[0], t[t.length - 1]]) {
    const end = document.createElement("span");
    end.textContent = `${Number(time.toPrecision(6))} s`;
    row.append(end);
  }
  parent.append(row);
}

// Mark the first plot with a reference and the first with a prediction, which have their keys.
function markFirst(plots) {
  const first = (kind) => plots.find((plot) => plot.lines.some((line) => line[kind].length));
  const [reference, predicted] = [first("reference"), first("linear")];
  if (reference) reference.pale = true;
  if (predicted) predicted.dashed = true;
}

// Which colour is whose, for this plot and those below it with the same names.
function makeKeysOf(named, lines) {
  if (!(named || []).length) return null;
  const keys = document.createElement("div");
  keys.className = "keys";
  const grey = new Set(lines.map((line) => line.label));
  for (const [label, colour, dashed] of named) {
    const key = document.createElement("span");
    key.classList.toggle("dashdot", Boolean(dashed));
    key.textContent = label;
    key.style.setProperty("--swatch", colour);
    keys.append(key);
    grey.delete(label);
  }
  if (grey.size) keys.append(`and ${grey.size} more in grey`);
  return keys;
}

// Give the plots of a panel the height that is there for them. Where they do not fit, the panel
// scrolls.
function fitPlots(panel) {
  const count = panel.querySelectorAll(".plot").length;
  const over = () => panel.scrollHeight - panel.clientHeight;
  for (let tall = TALL; ; tall = Math.max(LOW, tall - Math.max(2, Math.floor(over() / count)))) {
    panel.style.setProperty("--tall", `${tall}px`);
    if (over() <= 0 || tall === LOW || !count || window.innerWidth <= NARROW) return;
  }
}

// A chart of the panel. Dragging on it leads through time; a click leads there and enlarges it.
function makePlot(parent, t, plot, seek, marks, enlarge) {
  const at = element("span", { className: "at" }), canvas = element("canvas");
  const name = element("div", { className: "name" }, plot.unit ? `${plot.title} [${plot.unit}]` : plot.title, at);
  const keys = plot.raster ? null : makeKeysOf(plot.keys, plot.lines);
  if (plot.raster) canvas.style.height = `${ROW * plot.lines.length}px`;
  // x, y, z have room beside the title.
  if (keys && keys.textContent.length < 6) name.append(keys);
  const styles = [];
  if (plot.pale) styles.push(["pale", "reference"]);
  if (plot.dashed) styles.push(["dashed", "linear"]);
  const more = styles.map(([style, text]) => {
    const key = makeKeysOf([[text, UNNAMED]], []);
    key.classList.add(style);
    return key;
  });
  if (more.length === 1 && !(keys && keys.parentNode)) name.append(more[0]);
  const box = element("div", { className: "plot", title: "click to enlarge" }, name, ...[keys, ...more].filter((each) => each && !each.parentNode), canvas);
  parent.append(box);

  const chart = (plot.raster ? makeRaster : makeChart)(canvas, t, () => plot.lines, marks);
  let down = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down = event.clientX;
    seek(chart.under(event).time);
  });
  // The line nearest to the pointer, by its name, and its value there.
  canvas.addEventListener("pointermove", (event) => {
    const { time, i, line } = chart.under(event);
    at.textContent = `${line.label} ${chart.reading(line, i, time)}`.trim();
    at.style.color = line.colour === UNNAMED ? "var(--ink)" : line.colour;
    chart.raise(line);
    if (event.buttons) seek(time);
  });
  canvas.addEventListener("pointerleave", () => { at.textContent = ""; chart.raise(null); });
  box.addEventListener("click", (event) => { if (event.target !== canvas || Math.abs(event.clientX - down) < STILL) enlarge(plot); });
  return chart.show;
}
