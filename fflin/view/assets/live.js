// The live page: sliders that move the robot, and what the server says of where it is now.

function makeHeatMap(parent, names) {
  const box = document.createElement("div");
  box.className = "plot";
  const name = document.createElement("div");
  name.className = "name";
  const title = "inertia coupling";
  name.textContent = title;
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = names.length;
  canvas.className = "heat";
  box.append(name, canvas);
  parent.append(box);
  let values = [];
  canvas.addEventListener("pointermove", (event) => {
    const bounds = canvas.getBoundingClientRect(), n = names.length;
    const j = Math.floor(((event.clientX - bounds.left) / bounds.width) * n);
    const i = Math.floor(((event.clientY - bounds.top) / bounds.height) * n);
    if (names[i] && names[j] && values.length) name.textContent = `${names[i]} · ${names[j]}: ${values[i * n + j].toFixed(3)}`;
  });
  canvas.addEventListener("pointerleave", () => { name.textContent = title; });
  return (entries) => {
    values = entries;
    const context = canvas.getContext("2d"), image = context.createImageData(names.length, names.length);
    entries.forEach((value, k) => {
      const s = Math.sqrt(Math.abs(value));
      const colour = value >= 0 ? [40 + 215 * s, 60 + 120 * s, 90 - 40 * s] : [40 + 20 * s, 60 + 110 * s, 90 + 165 * s];
      image.data.set([...colour, 60 + 195 * s], 4 * k);
    });
    context.putImageData(image, 0, 0);
  };
}

function makeSlider(parent, joint, long, send) {
  const row = document.createElement("label");
  row.className = long ? "slider long" : "slider";
  const name = document.createElement("span"), value = document.createElement("b"), slider = document.createElement("input");
  name.textContent = joint.name;
  slider.type = "range";
  slider.min = joint.low; slider.max = joint.high; slider.step = "any";
  row.append(name, slider, value);
  parent.append(row);
  const show = (x) => { value.textContent = joint.length ? `${x.toFixed(3)} m` : `${((x * 180) / Math.PI).toFixed(1)}°`; };
  slider.addEventListener("input", () => { show(Number(slider.value)); send({ joints: { [joint.name]: Number(slider.value) } }); });
  return (x) => {
    show(x);
    if (document.activeElement !== slider || !slider.matches(":active")) slider.value = x;
  };
}

// The pose as Python code: the joints, and the base if it is not at the origin.
function codeOf(info, { joints, poses }) {
  const short = (x) => String(Number(x.toFixed(6)));
  const angles = info.joints.map(({ name }, k) => `${JSON.stringify(name)}: ${short(joints[k])}`).join(", ");
  const [x, y, z, ...turn] = poses[0];
  const home = [x, y, z, ...turn.slice(0, 3)].every((each) => Math.abs(each) < 1e-6);
  const base = home ? "" : `, pin.XYZQUATToSE3(np.array([${poses[0].map(short).join(", ")}]))`;
  const imports = home ? "import fflin" : "import numpy as np\nimport pinocchio as pin\n\nimport fflin";
  return `${imports}\n\nrobot = fflin.load(${JSON.stringify(info.title)})\nq = fflin.configuration(robot, {${angles}}${base})`;
}

function makeLive({ viewer, camera, turn }, info) {
  const panel = document.getElementById("panel");
  let socket = null;
  const send = (message) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(message)); };
  const row = document.createElement("div");
  row.className = "row";
  for (const [label, message] of [["neutral", { neutral: true }], ["random", { random: true }]]) {
    const button = document.createElement("button");
    button.textContent = label;
    button.addEventListener("click", () => send(message));
    row.append(button);
  }
  const code = element("pre", { id: "code", hidden: true }), show = element("button", { title: "the pose as Python code" }, "code");
  const write = () => { code.textContent = codeOf(info, live.state); };
  show.addEventListener("click", () => {
    code.hidden = !code.hidden || !live.state;
    if (code.hidden) return;
    write();
    navigator.clipboard?.writeText(code.textContent).catch(() => {}); // it can be selected by hand
  });
  row.append(show);
  panel.append(row, code);
  const long = info.joints.some((joint) => joint.name.length > 11); // than there is room for beside a slider
  const sliders = info.joints.map((joint) => makeSlider(panel, joint, long, send));
  const showHeat = makeHeatMap(panel, info.names);
  const showEquipment = makeEquipment(viewer, info), showLink = makePicking(viewer, info);
  const nodes = info.bodies.map((path) => viewer.scene_tree.find(path).object);
  const live = { ready: false, state: null, messages: 0 };

  const place = (node, pose) => {
    node.position.set(pose[0], pose[1], pose[2]);
    node.quaternion.set(pose[3], pose[4], pose[5], pose[6]);
  };
  const apply = (state) => {
    state.poses.forEach((pose, k) => place(nodes[k], pose));
    // What is followed is drawn when it is first asked for.
    state.joints.forEach((x, k) => sliders[k](x));
    if (state.coupling) showHeat(state.coupling);
    document.querySelector("header p").textContent = state.time === null ? info.subtitle : `t = ${state.time.toFixed(2)} s`;
    showEquipment();
    showLink();
    turn(state.time ?? 0);
    camera.step();
    live.state = state;
    if (!code.hidden) write();
    viewer.set_dirty();
  };
  const connect = () => {
    socket = new WebSocket(`ws://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { problem(""); live.ready = true; };
    socket.onmessage = (message) => {
      live.messages++;
      if (typeof message.data === "string") { apply(JSON.parse(message.data)); return; }
      try {
        viewer.handle_command_bytearray(new Uint8Array(message.data));
      } catch (error) {
        console.warn("a piece cannot be drawn:", error);
      }
    };
    socket.onclose = () => { problem("The connection to fflin is lost; reconnecting."); setTimeout(connect, 1000); };
  };
  makeKeys(viewKeys(camera, camera.setView));
  camera.reframe();
  connect();
  return live;
}
