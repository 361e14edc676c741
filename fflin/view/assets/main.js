// From the data of the page to the picture.

function decode(text) {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

const floats = (text) => new Float32Array(decode(text).buffer);

function problem(message) {
  const box = document.getElementById("problem");
  box.textContent = message;
  box.hidden = !message;
}

const GHOST = "#8fb4ff", HELD = "#b5926f", LINEAR = "#ff7fc8", SHADOW = "#5a6a86";

// The largest side of the box about points x, y, z, ...
function extent(points) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  points.forEach((x, i) => { low[i % 3] = Math.min(low[i % 3], x); high[i % 3] = Math.max(high[i % 3], x); });
  return Math.max(...high.map((x, k) => x - low[k]));
}

// The entries of constraints, of their forces and of their torques; each kind has one scale.
function constraintsOf({ constraints, reactions, couples }) {
  if (!constraints.length) return [];
  const names = constraints.map(({ name }) => name).join(", ");
  const label = constraints.length > 3 ? `${constraints.length} constraints` : `constraint${constraints.length > 1 ? "s" : ""} ${names}`;
  const entries = [{ label, colour: CONSTRAINT, paths: constraints.map(({ path }, k) => [...path, `constraint ${k}`]) }];
  for (const [kind, unit, arrows, node] of [["force", "N", reactions, "reactions"], ["torque", "N m", couples, "couples"]]) {
    if (!arrows.length) continue;
    const scale = `${kind} of constraints (longest: ${figure(strongest(arrows), 2)} ${unit})`;
    entries.push({ label: scale, colour: CONSTRAINT, paths: [["meshcat", node]] });
  }
  return entries;
}

// The entries of the magnetic field, and of moments and torque of magnetorquers.
function magneticOf({ field, moments }) {
  if (!field) return [];
  const limits = [...new Set(moments.map(({ most }) => most))];
  const full = limits.length > 1 ? "limit" : `${figure(limits[0], 2)} A m²`;
  const paths = moments.flatMap(({ name, path }) => ["rod", "moment"].map((kind) => [...path, `${kind} ${name}`]));
  const entries = [
    { label: `magnetic field (longest: ${figure(1e6 * largest(field.values, 3), 2)} µT)`, colour: MARKS.field, paths: [["meshcat", "wrench", "field"]] },
    { label: `magnetorquers (longest: ${full})`, colour: MARKS.moment, paths },
  ];
  const torque = largest(field.torque, 3);
  if (!torque) return entries;
  return [...entries, { label: `torque of magnetorquers (longest: ${figure(1e6 * torque, 2)} µN m)`, colour: MARKS.torque, paths: [["meshcat", "wrench", "magnetic torque"]] }];
}

// The checkbox of the shadow; a part of a revolution is too short for it.
function shadowOf({ orbit, t }) {
  if (!orbit || Math.abs(angleAt(orbit, t[t.length - 1]) - angleAt(orbit, t[0])) < 0.5) return [];
  return [{ label: "day and night", title: "the sun is fixed in space, and the shadow of the planet falls on the robot", colour: SHADOW, off: true, act: "shadow" }];
}

// What is drawn beside the robot and can be seen; each can be switched off.
function legendOf(info) {
  const entry = (label, colour, ...path) => ({ label, colour, paths: [["meshcat", ...path]] });
  if (info.mode === "modes") return [entry("at rest", GHOST, "rest")];
  const entries = [
    ...info.trails.filter(({ points }) => extent(points) > 0.02 * info.size).map(({ name }) => entry(`path of the ${name}`, MARKS[name], "trails", name)),
    ...Object.entries({ wheel: WHEEL, nozzle: NOZZLE }).filter(([kind]) => info[`${kind}s`].length).map(([kind, colour]) => (
      { label: kind === "wheel" ? "wheels" : "thrusters", colour, paths: info[`${kind}s`].map(({ path }, k) => [...path, `${kind} ${k}`]) })),
    ...constraintsOf(info),
    ...magneticOf(info),
    ...info.arrows.map(({ kind, unit, values }) => entry(`${kind} on the base (longest: ${figure(largest(values, 3), 2)} ${unit})`, MARKS[kind], "wrench", kind)),
  ];
  const rest = info.rest === null ? "" : `, at rest from ${Number(info.rest.toPrecision(4))} s`;
  const dashed = info.followed.length > 0;
  if (info.target) entries.push({ ...entry(dashed ? `reference${rest}` : "target", GHOST, "target"), dashed });
  entries.push(...info.held.map((name) => entry(name, HELD, "held", name)));
  if (info.linear) entries.push({ ...entry("linear model", LINEAR, "linear"), dashed: true });
  // In the panel thrusters are named in their plot; a strip of pictures has none.
  entries.push(...shadowOf(info));
  return [...entries, ...info.plumes.map(({ name, colour }) => ({ label: name, colour, strip: true }))];
}

// `acts` are functions of entries that do more than show what is drawn at their paths.
function makeLegend(viewer, entries, acts = {}) {
  const legend = document.getElementById("legend");
  for (const { label, title = "", colour, paths = [], strip, dashed, off, act } of entries) {
    const row = document.createElement("label"), check = document.createElement("input");
    row.className = strip ? "strip" : off ? "option" : "";
    row.title = title;
    const swatch = document.createElement("i");
    check.type = "checkbox";
    check.checked = !off;
    swatch.style.setProperty("--swatch", colour);
    swatch.className = dashed ? "dashed" : "";
    const set = () => {
      for (const path of paths) viewer.set_property(path, "visible", check.checked);
      if (act) acts[act](check.checked);
      viewer.set_dirty();
    };
    check.addEventListener("change", set);
    row.append(check, swatch, label);
    legend.append(row);
    set();
  }
}

function main() {
  const info = JSON.parse(document.getElementById("data").textContent);
  document.querySelector("h1").textContent = info.title;
  document.querySelector("header p").textContent = info.subtitle;
  let stage;
  try {
    stage = makeStage(info);
  } catch (error) {
    problem("This browser does not support WebGL, which this page needs.");
    console.warn(error);
    return;
  }
  const { viewer, camera, turn, shade } = stage;
  window.viewer = viewer;
  for (const command of info.commands) {
    try {
      viewer.handle_command_bytearray(decode(command));
    } catch (error) {
      console.warn("a piece cannot be drawn:", error);
    }
  }
  if (info.mode === "live") {
    window.fflin = makeLive(stage, info);
    return;
  }
  if (info.mode === "modes") {
    makeLegend(viewer, legendOf(info));
    window.fflin = makeModes(stage, info);
    if (playsAtOnce()) window.fflin.play();
    return;
  }

  info.t = floats(info.t);
  decodeOrbit(info);
  for (const each of [...info.trails, ...info.followed, ...info.reactions, ...info.couples]) each.points = floats(each.points);
  for (const each of [...info.arrows, ...info.plumes, ...info.reactions, ...info.couples, ...info.readouts]) each.values = floats(each.values);
  if (info.field) for (const key of ["values", "torque"]) info.field[key] = floats(info.field[key]);
  for (const each of info.moments) each.values = floats(each.values);
  for (const each of info.constraints) each.active = floats(each.active);
  for (const plot of info.plots) for (const line of plot.lines) for (const key of ["values", "reference", "linear"]) line[key] = floats(line[key]);
  markFirst(info.plots);
  for (const plot of info.plots) if (plot.raster) for (const line of plot.lines) line.pulses = decode(line.pulses);
  const thrusters = info.plots.filter((plot) => plot.family === "thrust").flatMap((plot) => plot.lines);
  const most = Math.max(...info.plumes.map(({ values }) => largest(values, 1)));
  info.plumes = info.plumes.filter((each) => thrusters.some(({ label }) => label === each.name)); // those that fire
  for (const each of info.plumes) Object.assign(each, { most, colour: thrusters.find(({ label }) => label === each.name).colour });
  const panel = document.getElementById("panel");
  const showMarks = makeMarks(viewer, info);
  const showFigures = makeReadouts(panel, info.readouts);
  makeConserved(panel, info.conserved);
  const showPhase = makePhases(panel, info.phases, (time) => goTo(time));
  const stamp = document.getElementById("stamp"), bar = document.getElementById("bar");
  const showEquipment = makeEquipment(viewer, info), showLink = makePicking(viewer, info);
  const deviation = floats(info.deviation.values);
  makeComparison(viewer, info, [...(info.target ? ["target"] : []), ...(info.linear ? ["linear"] : [])]);
  let charts = [];
  const quality = makeQuality(viewer);
  const player = makePlayer(viewer, info, quality, (i, time) => {
    turn(time);
    showMarks(i);
    showEquipment(i);
    showFigures(i);
    showLink();
    stamp.textContent = `t = ${figure(time, 3)} s${showPhase(time)}`;
    for (const show of charts) show(i, time);
    camera.step();
  });
  const goTo = (time) => { player.pause(); player.seek(time); };
  if (deviation.length) makeStrip(player.slider, info.t, deviation, info.deviation.levels);
  makePassed(panel, info.passed, goTo);
  const marks = [...info.phases.slice(1).map(([, start]) => start), info.rest].filter((time) => time !== null);
  const large = makeLarge(info, goTo, marks);
  charts = [...info.plots.map((plot) => makePlot(panel, info.t, plot, goTo, marks, large.open)), large.show];
  if (info.plots.length) makeSpan(panel, info.t);
  fitPlots(panel);
  const again = () => window.dispatchEvent(new Event("resize"));
  window.addEventListener("resize", () => fitPlots(panel));
  makeLegend(viewer, legendOf(info), { shadow: (on) => { shade(on); player.seek(player.state.time); } });

  const toggle = (text, title, pressed, act) => {
    const button = element("button", { title }, text);
    const press = (on) => { button.setAttribute("aria-pressed", on); act(on); };
    button.addEventListener("click", () => press(button.getAttribute("aria-pressed") !== "true"));
    button.setAttribute("aria-pressed", pressed);
    bar.append(button);
    return () => button.click();
  };
  const views = makeViews(bar, camera);
  const loop = toggle("↻", "play again and again", false, (on) => { player.state.loop = on; });
  bar.lastChild.setAttribute("aria-label", "loop");
  const follow = toggle("follow", "follow the base with the camera", camera.following(), camera.follow);
  // In a small window a panel that is folded has two readouts.
  const fold = toggle("panel", "show or fold the panel", !isSmall(), (on) => {
    document.body.classList.toggle("folded", !on && !isSmall());
    document.body.classList.toggle("opened", on);
    again();
  });
  document.body.classList.toggle("opened", !isSmall());
  const folds = bar.lastChild;
  folds.classList.add("fold");
  window.matchMedia(`(max-height: ${SMALL - 1}px)`).addEventListener("change", ({ matches }) => {
    if ((folds.getAttribute("aria-pressed") === "true") === matches) fold();
  });
  makeHelpButton(bar, makeKeys([...player.keys, ...views, ["l", "L", "play again and again", loop], ["f", "F", "follow the base", follow], ["p", "P", "show or fold the panel", fold]]));
  player.seek(askedTime() ?? player.first);
  camera.reframe();
  window.addEventListener("resize", () => requestAnimationFrame(() => player.seek(player.state.time)));
  const plain = (on, keyed) => {
    document.body.classList.toggle("plain", on);
    document.body.classList.toggle("keyed", Boolean(keyed));
    again();
  };
  window.fflin = { ...player, plain, quality, plots: info.plots, ready: true };
  window.addEventListener("hashchange", () => { if (askedTime() !== null) goTo(askedTime()); });
  if (playsAtOnce()) player.play();
}
