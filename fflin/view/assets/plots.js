// The panel of a motion: figures, what was passed, phases, and small charts.

const COLOURS = ["#ff7a70", "#7ad97f", "#6aa5ff", "#f6c35b", "#c58bff", "#5fd6d0", "#ff9ed0", "#b6c46a", "#9aa7ff", "#d79a6a", "#4fb08c", "#e05fa8"];
const NAMED = 8, UNNAMED = "#8a93a5"; // of more lines than colours those that change most are named

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

// Give the lines their colours: a name has one in all plots of a family, the first of which has keys.
function paint(plots) {
  const first = plots.find((plot) => plot.lines.some((line) => line.reference.length));
  if (first) first.pale = true; // has the key of the references
  const predicted = plots.find((plot) => plot.lines.some((line) => line.linear.length));
  if (predicted) predicted.dashed = true; // has the key of the linear model
  const change = (line) => line.values.reduce((a, b) => Math.max(a, b), -Infinity) - line.values.reduce((a, b) => Math.min(a, b), Infinity);
  for (const family of new Set(plots.map((plot) => plot.family))) {
    const kin = plots.filter((plot) => plot.family === family), most = new Map();
    for (const { lines } of kin) {
      const changes = lines.map(change), largest = Math.max(...changes) || 1;
      lines.forEach(({ label }, k) => most.set(label, Math.max(changes[k] / largest, most.get(label) || 0)));
    }
    let names = [...most.keys()];
    if (names.length > COLOURS.length) {
      const named = new Set([...names].sort((a, b) => most.get(b) - most.get(a)).slice(0, NAMED));
      names = names.filter((name) => named.has(name));
    }
    const axes = names.every((name) => "xyz".includes(name));
    const colours = new Map(names.map((name, k) => [name, COLOURS[axes ? "xyz".indexOf(name) : k]]));
    for (const { lines } of kin) for (const line of lines) line.colour = colours.get(line.label) || UNNAMED;
    if (names.some((name) => name)) kin[0].keys = [...colours];
  }
}

// Which colour is whose, for this plot and those below it with the same names.
function makeKeysOf(named, lines) {
  if (!(named || []).length) return null;
  const keys = document.createElement("div");
  keys.className = "keys";
  const grey = new Set(lines.map((line) => line.label));
  for (const [label, colour] of named) {
    const key = document.createElement("span");
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
  if (plot.dashed) styles.push(["dashed", "linear model"]);
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
    at.style.color = line.colour;
    if (event.buttons) seek(time);
  });
  canvas.addEventListener("pointerleave", () => { at.textContent = ""; });
  box.addEventListener("click", (event) => { if (event.target !== canvas || Math.abs(event.clientX - down) < STILL) enlarge(plot); });
  return chart.show;
}
