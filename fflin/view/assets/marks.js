// What is drawn about the robot: trails, forces, torques, reactions and plumes of thrusters.

const MARKS = { tool: "#ff9d4d", base: "#7fe3c4", "centre of mass": "#7fe3c4", force: "#ffd166", torque: "#d58cff", field: "#f2ead0", moment: "#ff6f61" };

// The largest length of the vectors of `size` entries in an array.
function largest(values, size) {
  let square = 0;
  for (let i = 0; i < values.length; i += size) {
    let sum = 0;
    for (let k = i; k < i + size; k++) sum += values[k] * values[k];
    square = Math.max(square, sum);
  }
  return Math.sqrt(square);
}

const strongest = (arrows) => Math.max(0, ...arrows.map(({ values }) => largest(values, 3)));

function flat(colour) {
  return new THREE.MeshBasicMaterial({ color: new THREE.Color(colour).convertSRGBToLinear(), toneMapped: false });
}

function arrow(colour, thickness, material = flat(colour)) {
  const group = new THREE.Group();
  const shaft = new THREE.Mesh(new THREE.CylinderGeometry(thickness, thickness, 1, 16), material);
  const tip = new THREE.Mesh(new THREE.ConeGeometry(2.6 * thickness, 7 * thickness, 20), material);
  shaft.renderOrder = tip.renderOrder = material.depthTest ? 0 : 5;
  group.add(shaft, tip);
  group.setLength = (length) => {
    const head = Math.min(7 * thickness, 0.6 * length);
    tip.scale.setScalar(head / (7 * thickness));
    tip.position.y = length - head / 2;
    shaft.scale.y = Math.max(length - head, 1e-9);
    shaft.position.y = (length - head) / 2;
  };
  return group;
}

// It begins inside the body that it acts on, and is seen through it.
function seenThrough(colour) {
  const material = flat(colour);
  material.depthTest = false;
  material.transparent = true;
  material.opacity = 0.92;
  return material;
}

const UP = new THREE.Vector3(0, 1, 0);

// A tube along all of the path, of which as much is drawn as has been passed; or all, in dashes.
function trail({ name, points, colour, radius, dashed }) {
  const group = new THREE.Group();
  const n = points.length / 3;
  const path = [];
  const at = []; // index in the tube of each frame
  for (let i = 0; i < n; i++) {
    const p = new THREE.Vector3().fromArray(points, 3 * i);
    if (!path.length || p.distanceTo(path[path.length - 1]) > 0.35 * radius) path.push(p);
    at.push(path.length - 1);
  }
  group.show = () => {};
  if (path.length < 2) return group;
  const around = 6;
  const curve = new THREE.CatmullRomCurve3(path, false, "centripetal");
  curve.getPointAt = (u) => curve.getPoint(u); // the points themselves, not equal lengths
  curve.getTangentAt = (u) => curve.getTangent(u);
  const tube = new THREE.TubeGeometry(curve, path.length - 1, radius, around);
  const paint = name === "base" ? seenThrough : flat; // it runs inside the body
  const whole = new THREE.Mesh(tube, Object.assign(paint(colour), { transparent: true, opacity: 0.16, depthWrite: false }));
  const order = whole.renderOrder = paint === flat ? 0 : 4;
  if (dashed) {
    const { array } = tube.index, shown = [];
    for (let k = 0, on = true, run = 0; k + 1 < path.length; k++) {
      if (on) shown.push(...array.subarray(6 * around * k, 6 * around * (k + 1)));
      run += path[k].distanceTo(path[k + 1]);
      if (run > 8 * radius) { on = !on; run = 0; }
    }
    tube.setIndex(shown);
    whole.material.opacity = 0.8;
    group.add(whole);
    return group;
  }
  const passed = new THREE.Mesh(tube.clone(), paint(colour));
  passed.renderOrder = order;
  group.add(whole, passed);
  group.show = (i) => passed.geometry.setDrawRange(0, 6 * around * at[i]);
  return group;
}

// Turn an arrow along force i and set its length; a short arrow is hidden.
function showForce(group, values, i, { longest, most, size }) {
  const force = new THREE.Vector3().fromArray(values, 3 * i);
  const length = (longest * force.length()) / most;
  group.visible = length > 0.004 * size;
  if (!group.visible) return;
  group.setLength(length);
  group.quaternion.setFromUnitVectors(UP, force.normalize());
}

function forceArrow({ colour, values, longest, size }) {
  const most = largest(values, 3);
  const group = arrow(colour, 0.010 * size, seenThrough(colour));
  group.show = (i) => showForce(group, values, i, { longest, most, size });
  return group;
}

// The force of a constraint, at the frame on which it acts; all constraints have one scale.
function reactionArrow({ points, values, longest, most, size }) {
  const group = arrow(CONSTRAINT, 0.008 * size, seenThrough(CONSTRAINT));
  group.show = (i) => {
    group.position.fromArray(points, 3 * i);
    showForce(group, values, i, { longest, most, size });
  };
  return group;
}

// The torque of a constraint about the frame on which it acts; all constraints have one scale.
function coupleArrow({ points, size, ...each }) {
  const group = torqueArrow({ ...each, size, colour: CONSTRAINT, radius: 0.06 * size });
  const { show } = group;
  group.show = (i) => {
    group.position.fromArray(points, 3 * i);
    show(i);
  };
  return group;
}

// An arrow along the axis with an arc about it, both as long as the torque is large.
function torqueArrow({ colour, values, longest, size, most = largest(values, 3), radius = 0.17 * size }) {
  const group = new THREE.Group();
  const material = seenThrough(colour);
  const thickness = 0.04 * radius;
  const axis = arrow(colour, thickness, material);
  const arc = new THREE.Group();
  const ring = new THREE.Mesh(new THREE.TorusGeometry(radius, thickness, 10, 60, 1.6 * Math.PI), material);
  const tip = new THREE.Mesh(new THREE.ConeGeometry(0.13 * radius, 0.35 * radius, 18), material);
  ring.renderOrder = tip.renderOrder = 5;
  tip.position.set(radius * Math.cos(1.6 * Math.PI), radius * Math.sin(1.6 * Math.PI), 0);
  tip.rotation.z = 1.6 * Math.PI;
  arc.add(ring, tip);
  arc.rotation.x = -Math.PI / 2;
  group.add(axis, arc);
  group.show = (i) => {
    const torque = new THREE.Vector3().fromArray(values, 3 * i);
    const share = torque.length() / most;
    group.visible = share > 0.006;
    if (!group.visible) return;
    const length = longest * share;
    axis.setLength(length);
    arc.position.y = 0.55 * length;
    arc.scale.setScalar(0.25 + 0.75 * share);
    group.quaternion.setFromUnitVectors(UP, torque.normalize());
  };
  return group;
}

// The magnetic field at the base: an arrow as long as the field is strong, on its field line, which
// is straight over the size of a robot and fades away from it.
function fieldArrow({ values, longest, size }) {
  const most = largest(values, 3), reach = 4 * size;
  const group = new THREE.Group();
  const pointer = arrow(MARKS.field, 0.009 * size, seenThrough(MARKS.field));
  const line = new THREE.Mesh(new THREE.CylinderGeometry(0.0045 * size, 0.0045 * size, 2 * reach, 8, 1, true), new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, uniforms: { reach: { value: reach }, tint: { value: new THREE.Color(MARKS.field).convertSRGBToLinear() } },
    vertexShader: `
      varying float along; uniform float reach;
      void main() {
        along = abs(position.y) / reach;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      }`,
    fragmentShader: `
      varying float along; uniform vec3 tint;
      void main() {
        gl_FragColor = vec4(tint, 0.8 * pow(1.0 - along, 1.3));
        #include <encodings_fragment>
      }`,
  }));
  line.renderOrder = 3;
  group.add(pointer, line);
  group.show = (i) => {
    const field = new THREE.Vector3().fromArray(values, 3 * i);
    group.visible = field.length() > 0;
    if (!group.visible) return;
    pointer.setLength((longest * field.length()) / most);
    group.quaternion.setFromUnitVectors(UP, field.normalize());
  };
  return group;
}

// The moment of a magnetorquer, along its rod; at its limit the arrow has its longest length.
function momentArrow({ position, axis, values, longest, most, size }) {
  const group = arrow(MARKS.moment, 0.012 * size, seenThrough(MARKS.moment));
  const along = new THREE.Vector3(...axis);
  group.position.set(...position);
  group.show = (i) => {
    const length = (longest * Math.abs(values[i])) / most;
    group.visible = length > 0.01 * size;
    if (!group.visible) return;
    group.setLength(length);
    group.quaternion.setFromUnitVectors(UP, along.clone().multiplyScalar(Math.sign(values[i])));
  };
  return group;
}

function plume({ position, direction, values, most, size, colour }) {
  const length = 0.48 * size, radius = 0.07 * size;
  const cone = new THREE.ConeGeometry(radius, length, 28, 12, true);
  cone.translate(0, -length / 2, 0); // the nozzle at the origin, the gas along -y
  const material = new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, side: THREE.DoubleSide, blending: THREE.AdditiveBlending,
    uniforms: { length: { value: length }, power: { value: 0 }, tint: { value: new THREE.Color(colour).convertSRGBToLinear() } },
    vertexShader: `
      varying float along; varying vec3 n; varying vec3 eye; uniform float length;
      void main() {
        along = -position.y / length;
        vec4 p = modelViewMatrix * vec4(position, 1.0);
        n = normalMatrix * normal; eye = -p.xyz;
        gl_Position = projectionMatrix * p;
      }`,
    fragmentShader: `
      varying float along; varying vec3 n; varying vec3 eye; uniform float power; uniform vec3 tint;
      void main() {
        float core = pow(abs(dot(normalize(n), normalize(eye))), 1.4);
        float fade = pow(1.0 - along, 1.8);
        vec3 colour = mix(tint, vec3(1.0, 0.93, 0.85), pow(1.0 - along, 5.0));
        gl_FragColor = vec4(1.9 * colour * core * fade * (0.4 + 0.6 * power), 1.0);
      }`,
  });
  const group = new THREE.Group();
  const gas = new THREE.Mesh(cone, material);
  group.add(gas);
  group.position.set(...position);
  const push = new THREE.Vector3(...direction);
  group.show = (i) => {
    const share = values[i] / most;
    group.visible = Math.abs(share) > 0.005;
    material.uniforms.power.value = Math.abs(share);
    gas.scale.set(0.5 + 0.5 * Math.sqrt(Math.abs(share)), Math.abs(share) || 1e-6, 0.5 + 0.5 * Math.sqrt(Math.abs(share)));
    group.quaternion.setFromUnitVectors(UP, push.clone().multiplyScalar(share < 0 ? -1 : 1));
  };
  return group;
}

// Put all marks into the scene. Returns what shows frame i of them.
function makeMarks(viewer, info) {
  const shows = [];
  const add = (path, mark) => {
    viewer.scene_tree.find(path).object.add(mark);
    if (mark.show) shows.push(mark.show);
  };
  const { size } = info;
  info.trails.forEach((each) => add(["meshcat", "trails", each.name], trail({ ...each, colour: MARKS[each.name], radius: 0.0055 * size })));
  info.followed.forEach((each, k) => add(["meshcat", "target", `path ${k}`], trail({ ...each, colour: GHOST, radius: 0.004 * size, dashed: true })));
  const wrench = viewer.scene_tree.find(["meshcat", "wrench"]).object;
  const base = viewer.scene_tree.find(info.base).object;
  for (const each of info.arrows) {
    add(["meshcat", "wrench", each.kind], (each.kind === "force" ? forceArrow : torqueArrow)({ ...each, colour: MARKS[each.kind], size }));
  }
  if (info.field) {
    add(["meshcat", "wrench", "field"], fieldArrow({ ...info.field, size }));
    const { torque, torqueLongest } = info.field;
    if (largest(torque, 3) > 0) add(["meshcat", "wrench", "magnetic torque"], torqueArrow({ colour: MARKS.torque, values: torque, longest: torqueLongest, size }));
  }
  info.moments.forEach((each) => add([...each.path, `moment ${each.name}`], momentArrow({ ...each, size })));
  const most = strongest(info.reactions);
  info.reactions.forEach((each, k) => add(["meshcat", "reactions", `${k}`], reactionArrow({ ...each, most, size })));
  const mostTorque = strongest(info.couples);
  info.couples.forEach((each, k) => add(["meshcat", "couples", `${k}`], coupleArrow({ ...each, most: mostTorque, size })));
  info.plumes.forEach((each, k) => add([...each.path, `plume ${k}`], plume({ ...each, size })));
  return (i) => {
    wrench.position.copy(base.position);
    for (const show of shows) show(i);
  };
}
