// Thrusters that are off or on: one strip each along the time, with its name and its duty.

const ROW = 22, STRIP = 6, LETTERS = 10.5; // height of a thruster, its strip and its name [CSS pixels]
const FAINT = 0.45; // opacity of the shortest pulse

// As `makeChart`. The pulses of a line are the fractions of time that it is on, of 255.
function makeRaster(canvas, t, curves, marks, large = false) {
  const first = t[0], duration = t[t.length - 1] - first || 1;
  const gutter = large ? WIDE_GUTTER : GUTTER;
  let drawn = null, lines = [], width = 0, height = 0, ratio = 1;
  const right = () => width - gutter * ratio;
  const row = () => Math.min(height / lines.length, 2.5 * ROW * ratio);
  const draw = () => {
    ratio = window.devicePixelRatio || 1;
    width = canvas.width = Math.round(canvas.clientWidth * ratio);
    height = canvas.height = Math.round(canvas.clientHeight * ratio);
    if (!width) return;
    lines = curves();
    drawn = element("canvas", { width, height });
    const context = drawn.getContext("2d"), style = getComputedStyle(document.body);
    const [ink, faint, back] = ["--ink", "--faint", "--line"].map((name) => style.getPropertyValue(name));
    context.font = `${LETTERS * ratio}px system-ui, sans-serif`;
    lines.forEach(({ label, colour, pulses, duty }, k) => {
      const bottom = Math.round((k + 1) * row() - 2 * ratio), tall = Math.round((large ? row() / 2 : STRIP * ratio));
      const cell = right() / pulses.length;
      Object.assign(context, { fillStyle: ink, globalAlpha: 1, textAlign: "left" });
      context.fillText(label, 0, bottom - tall - 3 * ratio);
      Object.assign(context, { fillStyle: faint, textAlign: large ? "left" : "right" });
      context.fillText(percentOf(duty), large ? right() + 6 * ratio : width - ratio, bottom);
      context.fillStyle = back;
      context.fillRect(0, bottom - tall, right(), tall);
      context.fillStyle = colour;
      pulses.forEach((level, i) => {
        if (!level) return;
        context.globalAlpha = FAINT + ((1 - FAINT) * level) / 255;
        context.fillRect(i * cell, bottom - tall, Math.max(cell, 1), tall);
      });
    });
  };
  const show = (i, time) => {
    if (!drawn || canvas.width !== width) draw();
    if (!drawn) return;
    withCursor(canvas, drawn, ((time - first) / duration) * right(), row() * lines.length, ratio);
  };
  const under = (event) => {
    const bounds = canvas.getBoundingClientRect();
    const time = first + duration * Math.min(1, Math.max(0, (event.clientX - bounds.left) / (bounds.width - gutter)));
    const after = t.findIndex((each) => each >= time), k = Math.floor(((event.clientY - bounds.top) * ratio) / row());
    return { time, i: after < 0 ? t.length - 1 : after, line: lines[Math.min(lines.length - 1, Math.max(0, k))] || null };
  };
  const redraw = () => { drawn = null; };
  window.addEventListener("resize", redraw);
  const reading = ({ pulses, duty }, i, time) => {
    const k = Math.min(pulses.length - 1, Math.floor(((time - first) / duration) * pulses.length));
    return `${pulses[k] ? "on" : "off"}, duty ${percentOf(duty)}`;
  };
  return { show, under, redraw, reading, raise: () => {} };
}

const percentOf = (share) => `${Number((100 * share).toPrecision(2))} %`;
