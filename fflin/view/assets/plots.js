// Small plots over time with a cursor, and figures, on plain canvases.

const GUTTER = 44; // for the figures of the axis, right of the lines [CSS pixels]

const COLOURS = ["#ff7a70", "#7ad97f", "#6aa5ff", "#f6c35b", "#c58bff", "#5fd6d0", "#ff9ed0", "#b6c46a", "#9aa7ff", "#d79a6a", "#4fb08c", "#e05fa8"];
const NAMED = 8, UNNAMED = "#8a93a5"; // of more lines than colours those that change most are named

const TALL = 62, LOW = 30; // heights of a plot where there is room, and at least

function figure(value, digits) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-3) return value.toExponential(1);
  return size >= 10 ** digits ? value.toFixed(0) : value.toPrecision(digits);
}

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
function makeKeys(named, lines) {
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

// Give the plots of a panel the height that is there for them, in a wide window in two columns
// where one is too short. Returns whether the panel has another width by that.
function fitPlots(panel) {
  const count = panel.querySelectorAll(".plot").length, width = panel.clientWidth;
  const over = () => Math.max(panel.scrollHeight - panel.clientHeight, panel.scrollWidth - panel.clientWidth);
  const fit = (wide) => {
    panel.classList.toggle("wide", wide);
    for (let tall = TALL; ; tall = Math.max(LOW, tall - Math.max(2, Math.floor(over() / count)))) {
      panel.style.setProperty("--tall", `${tall}px`);
      if (over() <= 0 || tall === LOW || !count) return over() <= 0;
    }
  };
  if (!fit(false) && window.innerWidth >= 1100) fit(true);
  return panel.clientWidth !== width;
}

function makePlot(parent, t, plot, seek, marks) {
  const box = document.createElement("div");
  box.className = "plot";
  const name = document.createElement("div"), at = document.createElement("span");
  name.className = "name";
  name.append(plot.unit ? `${plot.title} [${plot.unit}]` : plot.title, at);
  at.className = "at";
  const canvas = document.createElement("canvas");
  const keys = makeKeys(plot.keys, plot.lines);
  // x, y, z have room beside the title.
  if (keys && keys.textContent.length < 6) name.append(keys);
  const pale = plot.pale ? makeKeys([["reference", UNNAMED]], []) : null;
  if (pale) pale.classList.add("pale");
  if (pale && !(keys && keys.parentNode)) name.append(pale);
  box.append(name, ...[keys, pale].filter((each) => each && !each.parentNode), canvas);
  parent.append(box);

  const values = [...plot.lines.flatMap((line) => [...line.values, ...line.reference]).filter(Number.isFinite), ...plot.lines.flatMap((line) => line.limits)];
  let low = Math.min(0, ...[values.reduce((a, b) => Math.min(a, b), Infinity)]);
  let high = Math.max(0, ...[values.reduce((a, b) => Math.max(a, b), -Infinity)]);
  const least = low, most = high;
  if (!(high - low > 0)) { low -= 1; high += 1; }
  const spare = 0.06 * (high - low);
  if (low < 0) low -= spare;
  if (high > 0) high += spare;
  const first = t[0], duration = t[t.length - 1] - first || 1;
  let drawn = null, width = 0, height = 0, ratio = 1;
  const x = (time) => ((time - first) / duration) * (width - (GUTTER + 2) * ratio) + ratio;
  const y = (value) => (1 - (value - low) / (high - low)) * (height - 2 * ratio) + ratio;

  const draw = () => {
    ratio = window.devicePixelRatio || 1;
    width = canvas.width = Math.round(canvas.clientWidth * ratio);
    height = canvas.height = Math.round(canvas.clientHeight * ratio);
    if (!width) return;
    drawn = document.createElement("canvas");
    drawn.width = width; drawn.height = height;
    const context = drawn.getContext("2d");
    const style = getComputedStyle(document.body);
    context.strokeStyle = style.getPropertyValue("--line");
    context.lineWidth = ratio;
    context.beginPath();
    for (const level of [low, 0, high]) { context.moveTo(0, y(level)); context.lineTo(width - GUTTER * ratio, y(level)); }
    context.stroke();
    context.lineJoin = "round";
    context.setLineDash([5 * ratio, 4 * ratio]);
    for (const { colour, limits } of plot.lines) for (const level of limits) {
      context.strokeStyle = colour;
      context.beginPath();
      context.moveTo(0, y(level)); context.lineTo(width - GUTTER * ratio, y(level));
      context.stroke();
    }
    context.strokeStyle = style.getPropertyValue("--faint");
    context.setLineDash([ratio, 2 * ratio]);
    context.beginPath();
    for (const mark of new Set(marks)) { context.moveTo(x(mark), 0); context.lineTo(x(mark), height); }
    context.stroke();
    context.setLineDash([]);
    const curve = (values, colour, thickness, alpha) => {
      context.strokeStyle = colour;
      context.lineWidth = thickness * ratio;
      context.globalAlpha = alpha;
      context.beginPath();
      values.forEach((value, i) => context.lineTo(x(t[i]), y(value)));
      context.stroke();
    };
    // The band between what is followed and what is flown.
    for (const { values, reference, colour } of plot.lines) {
      if (!reference.length) continue;
      context.fillStyle = colour;
      context.globalAlpha = 0.18;
      context.beginPath();
      values.forEach((value, i) => context.lineTo(x(t[i]), y(value)));
      for (let i = values.length - 1; i >= 0; i--) context.lineTo(x(t[i]), y(reference[i]));
      context.fill();
    }
    for (const { reference, colour } of plot.lines) curve(reference, colour, 4, 0.4);
    for (const { values, colour } of plot.lines) curve(values, colour, 1.4, 1);
    context.fillStyle = style.getPropertyValue("--faint");
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    context.textBaseline = "middle";
    context.textAlign = "right";
    const half = 6 * ratio, taken = [];
    for (const value of [most, least, 0]) {
      const at = Math.min(height - half, Math.max(half, y(value)));
      if (taken.some((other) => Math.abs(other - at) < 1.7 * half)) continue;
      taken.push(at);
      context.fillText(figure(value, 2), width - ratio, at);
    }
  };
  const show = (i, time) => {
    if (!drawn || canvas.width !== width) draw();
    if (!drawn) return;
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    context.drawImage(drawn, 0, 0);
    context.strokeStyle = getComputedStyle(document.body).getPropertyValue("--ink");
    context.globalAlpha = 0.75;
    context.lineWidth = ratio;
    context.beginPath();
    context.moveTo(x(time), 0); context.lineTo(x(time), height);
    context.stroke();
    context.globalAlpha = 1;
    plot.lines.forEach((line) => {
      context.fillStyle = line.colour;
      context.beginPath();
      context.arc(x(time), y(line.values[i]), 2.3 * ratio, 0, 7);
      context.fill();
    });
  };
  const under = (event) => {
    const bounds = canvas.getBoundingClientRect();
    return first + duration * Math.min(1, Math.max(0, (event.clientX - bounds.left) / (bounds.width - GUTTER)));
  };
  const pick = (event) => seek(under(event));
  // The line nearest to the pointer, by its name, and its value there.
  const tell = (event) => {
    const time = under(event), row = (event.clientY - canvas.getBoundingClientRect().top) * ratio;
    const after = t.findIndex((each) => each >= time), i = after < 0 ? t.length - 1 : after;
    const away = (line) => Math.abs(y(line.values[i]) - row);
    const { label, values, colour } = plot.lines.reduce((a, b) => (away(b) < away(a) ? b : a));
    at.textContent = `${label} ${figure(values[i], 3)}`.trim();
    at.style.color = colour;
  };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); pick(event); });
  canvas.addEventListener("pointermove", (event) => { tell(event); if (event.buttons) pick(event); });
  canvas.addEventListener("pointerleave", () => { at.textContent = ""; });
  window.addEventListener("resize", () => { drawn = null; });
  return show;
}
