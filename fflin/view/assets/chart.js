// A chart over time on a canvas: levels, limits, references and curves, and a cursor over them.

// Figures of the axis are right of the lines; a large chart has the times below [CSS pixels].
const GUTTER = 44, WIDE_GUTTER = 52, FOOT = 24;

const DASHES = [3, 3]; // of a linear prediction [CSS pixels]
const DASH_DOT = [8, 2, 2, 2]; // of the colours from the sixth on

function figure(value, digits) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-3) return value.toExponential(1);
  return size >= 10 ** digits ? value.toFixed(0) : value.toPrecision(digits);
}

// Round numbers from low to high, at most so many.
function roundLevels(low, high, most) {
  const least = (high - low) / most, ten = 10 ** Math.floor(Math.log10(least));
  const step = ten * [1, 2, 5, 10].find((each) => each * ten >= least);
  const levels = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) levels.push(Number((k * step).toPrecision(6)));
  return levels;
}

// Copies what is drawn to a canvas, with a line at x from the top to `bottom`; returns its context.
function withCursor(canvas, drawn, x, bottom, ratio) {
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.drawImage(drawn, 0, 0);
  Object.assign(context, { strokeStyle: getComputedStyle(document.body).getPropertyValue("--ink"), globalAlpha: 0.75, lineWidth: ratio });
  context.beginPath();
  context.moveTo(x, 0); context.lineTo(x, bottom);
  context.stroke();
  context.globalAlpha = 1;
  return context;
}

// `curves` returns those that are shown; `large` charts have a grid at round levels.
function makeChart(canvas, t, curves, marks, large = false) {
  const first = t[0], duration = t[t.length - 1] - first || 1;
  const gutter = large ? WIDE_GUTTER : GUTTER, foot = large ? FOOT : 0;
  let drawn = null, raised = null, last = [0, first], lines = [], width = 0, height = 0, ratio = 1, low = 0, high = 1;
  const x = (time) => ((time - first) / duration) * (width - (gutter + 2) * ratio) + ratio;
  const y = (value) => (1 - (value - low) / (high - low)) * (height - (2 + foot) * ratio) + ratio;

  const scale = () => {
    low = high = 0;
    for (const { values, reference, linear, limits } of lines) for (const each of [values, reference, linear, limits]) for (const value of each) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
    const ends = [high, low].map((end) => (Math.abs(end) > 1e-6 * (high - low) ? end : 0)); // the rest is rounding
    if (!(high - low > 0)) { low -= 1; high += 1; }
    const spare = 0.06 * (high - low);
    if (low < 0) low -= spare;
    if (high > 0) high += spare;
    return large ? roundLevels(low, high, Math.max(2, height / ratio / 48)) : [...ends, 0];
  };
  const draw = () => {
    ratio = window.devicePixelRatio || 1;
    width = canvas.width = Math.round(canvas.clientWidth * ratio);
    height = canvas.height = Math.round(canvas.clientHeight * ratio);
    if (!width) return;
    lines = curves();
    const levels = scale(), right = width - gutter * ratio, bottom = height - foot * ratio;
    drawn = element("canvas", { width, height });
    const context = drawn.getContext("2d"), style = getComputedStyle(document.body);
    const stroke = (colour, dashes, paths) => {
      context.strokeStyle = colour;
      context.setLineDash(dashes.map((each) => each * ratio));
      context.beginPath();
      for (const [from, to] of paths) { context.moveTo(...from); context.lineTo(...to); }
      context.stroke();
    };
    const across = (level) => [[0, y(level)], [right, y(level)]], along = (time) => [[x(time), 0], [x(time), bottom]];
    const times = large ? roundLevels(first, first + duration, Math.max(2, width / ratio / 90)) : [];
    context.lineWidth = ratio;
    context.lineJoin = "round";
    stroke(style.getPropertyValue("--line"), [], [...(large ? levels : [low, 0, high]).map(across), ...times.map(along)]);
    for (const { colour, limits } of lines) stroke(colour, [5, 4], limits.map(across));
    stroke(style.getPropertyValue("--faint"), [1, 2], [...new Set(marks)].map(along));
    context.setLineDash([]);
    const trace = (values) => { context.beginPath(); values.forEach((value, i) => context.lineTo(x(t[i]), y(value))); };
    const curve = (values, colour, thickness, alpha) => {
      Object.assign(context, { strokeStyle: colour, lineWidth: thickness * ratio, globalAlpha: alpha });
      trace(values);
      context.stroke();
    };
    // The band between what is followed and what is flown.
    for (const { values, reference, colour } of lines) {
      if (!reference.length) continue;
      Object.assign(context, { fillStyle: colour, globalAlpha: 0.18 });
      trace(values);
      for (let i = values.length - 1; i >= 0; i--) context.lineTo(x(t[i]), y(reference[i]));
      context.fill();
    }
    for (const { reference, colour } of lines) curve(reference, colour, 4, 0.4);
    const own = (line) => {
      context.setLineDash(line.dashed ? DASH_DOT.map((each) => each * ratio) : []);
      const colour = line === raised && line.colour === UNNAMED ? style.getPropertyValue("--ink") : line.colour;
      curve(line.values, colour, (large ? 1.8 : 1.4) * (line === raised ? 1.6 : 1), 1);
    };
    // Grey curves lie below the others, and the one that is pointed at above all.
    const rank = (line) => (line === raised ? 2 : line.colour === UNNAMED ? 0 : 1);
    [...lines].sort((a, b) => rank(a) - rank(b)).forEach(own);
    // What the linear model predicts.
    context.setLineDash(DASHES.map((each) => each * ratio));
    for (const { linear, colour } of lines) curve(linear, colour, large ? 1.4 : 1.1, 0.95);
    context.setLineDash([]);
    Object.assign(context, {
      globalAlpha: 1, fillStyle: style.getPropertyValue("--faint"), font: `${(large ? 12 : 11) * ratio}px system-ui, sans-serif`,
      textBaseline: "middle", textAlign: large ? "left" : "right",
    });
    const half = 6 * ratio, taken = [];
    for (const value of levels) {
      const at = Math.min(bottom - half, Math.max(half, y(value)));
      if (taken.some((other) => Math.abs(other - at) < 1.7 * half)) continue;
      taken.push(at);
      context.fillText(large ? String(value) : figure(value, 2), large ? right + half : width - ratio, at);
    }
    context.textAlign = "center";
    for (const time of times) context.fillText(`${time} s`, Math.min(right, Math.max(3 * half, x(time))), height - 0.4 * foot * ratio);
  };
  const show = (i, time) => {
    last = [i, time];
    if (!drawn || canvas.width !== width) draw();
    if (!drawn) return;
    const context = withCursor(canvas, drawn, x(time), height - foot * ratio, ratio);
    for (const { colour, values } of lines) {
      context.fillStyle = colour;
      context.beginPath();
      context.arc(x(time), y(values[i]), (large ? 3.4 : 2.3) * ratio, 0, 7);
      context.fill();
    }
  };
  // The time under the pointer, its row among the data, and the curve nearest to it.
  const under = (event) => {
    const bounds = canvas.getBoundingClientRect(), row = (event.clientY - bounds.top) * ratio;
    const time = first + duration * Math.min(1, Math.max(0, (event.clientX - bounds.left) / (bounds.width - gutter)));
    const after = t.findIndex((each) => each >= time), i = after < 0 ? t.length - 1 : after;
    const away = (line) => Math.abs(y(line.values[i]) - row);
    return { time, i, line: lines.length ? lines.reduce((a, b) => (away(b) < away(a) ? b : a)) : null };
  };
  const redraw = () => { drawn = null; };
  const raise = (line) => {
    if (line === raised) return;
    raised = line;
    redraw();
    show(...last);
  };
  window.addEventListener("resize", redraw);
  return { show, under, redraw, raise, reading: (line, i) => figure(line.values[i], large ? 4 : 3) };
}
