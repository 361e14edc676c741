// Natural modes: the robot swings in one of them at a time, about where it stands.

// Whether a phase [deg] is neither 0 nor 180, and the sign of what moves with it if it is one.
const aside = (phase) => Math.abs(Math.sin((phase * Math.PI) / 180)) > 0.02;
const sign = (phase) => (!aside(phase) && Math.abs(phase) > 90 ? "−" : "");

// A mode by the one or two bodies that have most of its kinetic energy.
function nameOf({ energy }) {
  const [first, second] = energy.map(([name, part]) => `${name} ${(100 * part).toFixed(0)}\u00a0%`);
  return second && energy[1][1] > 0.5 * energy[0][1] ? `${first}, ${second}` : first;
}

function makeModes({ viewer, camera }, info) {
  const panel = document.getElementById("panel"), bar = document.getElementById("bar");
  const nodes = info.bodies.map((path) => viewer.scene_tree.find(path).object), n = nodes.length;
  info.modes.forEach((mode) => { mode.poses = floats(mode.poses); });
  makeEquipment(viewer, info)();

  const list = document.createElement("div"), shape = document.createElement("div");
  const head = document.createElement("div");
  list.className = "choices";
  head.className = "figures";
  const cells = (parent, texts) => texts.forEach((text) => parent.append(Object.assign(document.createElement("span"), { textContent: text })));
  cells(head, ["rad/s", "Hz", "damping"]);
  head.title = "modes, named by the bodies with most of the kinetic energy";
  shape.className = "readouts shape";
  const rows = info.modes.map((mode, k) => {
    const row = document.createElement("button"), name = document.createElement("b"), figures = document.createElement("div");
    name.textContent = nameOf(mode) + (mode.unstable ? " (unstable)" : "");
    figures.className = "figures";
    cells(figures, [figure(mode.frequency, 4), figure(mode.frequency / (2 * Math.PI), 4), figure(mode.damping, 3)]);
    row.append(name, figures);
    row.addEventListener("click", () => pick(k));
    list.append(row);
    return row;
  });
  panel.append(head, list, shape);
  const button = document.createElement("button"), slider = document.createElement("input"), pace = document.createElement("output");
  button.className = "play";
  Object.assign(slider, { type: "range", min: 0, max: 1, step: "any", value: 0 });
  slider.setAttribute("aria-label", "phase");
  bar.append(button, slider, pace);

  const state = { mode: 0, phase: 0, playing: false };
  const position = new THREE.Vector3(), turn = new THREE.Quaternion();
  let then = 0;
  const seek = (phase) => {
    state.phase = phase - Math.floor(phase);
    const { poses } = info.modes[state.mode], count = poses.length / (7 * n);
    const at = state.phase * count, i = Math.floor(at) % count, j = (i + 1) % count, share = at - Math.floor(at);
    nodes.forEach((node, k) => {
      const a = 7 * (i * n + k), b = 7 * (j * n + k);
      node.position.fromArray(poses, a).lerp(position.fromArray(poses, b), share);
      node.quaternion.fromArray(poses, a + 3).slerp(turn.fromArray(poses, b + 3), share);
    });
    slider.value = state.phase;
    viewer.set_dirty();
  };
  const pick = (k) => {
    state.mode = Math.min(rows.length - 1, Math.max(0, k));
    rows.forEach((row, other) => row.setAttribute("aria-pressed", other === state.mode));
    rows[state.mode].scrollIntoView({ block: "nearest" });
    const mode = info.modes[state.mode], ratio = (mode.frequency / (2 * Math.PI)) * info.period;
    pace.textContent = `shown at ${figure(1 / info.period, 2)} Hz, ${figure(Math.max(ratio, 1 / ratio), 2)}× ${ratio > 1 ? "slower" : "faster"}`;
    shape.textContent = "";
    for (const [name, unit, size, phase] of mode.shape) {
      const left = document.createElement("span"), right = document.createElement("b");
      left.textContent = name;
      right.textContent = `${sign(phase)}${figure(size, 2)} ${unit === "1" ? "" : unit}${aside(phase) ? ` at ${phase.toFixed(0)}°` : ""}`.trim();
      shape.append(left, right);
    }
    seek(state.phase);
  };
  const mark = () => {
    button.textContent = state.playing ? "❚❚" : "▶";
    button.setAttribute("aria-label", state.playing ? "pause" : "play");
  };
  const play = () => { state.playing = true; then = performance.now(); mark(); };
  const pause = () => { state.playing = false; mark(); };
  viewer.animator.update = () => {
    if (!state.playing) return;
    const now = performance.now();
    seek(state.phase + (now - then) / 1000 / info.period);
    then = now;
  };
  button.addEventListener("click", () => (state.playing ? pause() : play()));
  slider.addEventListener("input", () => { pause(); seek(Number(slider.value)); });
  makePicking(viewer, info);
  const views = makeViews(bar, camera);
  makeHelpButton(bar, makeKeys([
    [" ", "space", "play or pause", () => (state.playing ? pause() : play())],
    ["ArrowDown", "↓", "next mode", () => pick(state.mode + 1)],
    ["ArrowUp", "↑", "mode before", () => pick(state.mode - 1)],
    ...views,
  ]));
  mark();
  pick(0);
  camera.step();
  camera.reframe();
  return { seek, pick, play, pause, state, ready: true };
}
