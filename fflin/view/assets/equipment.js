// What is fixed to the robot's bodies and has no shape in its URDF: axes, thrusters, wheels,
// magnetorquers and constraints.

const NOZZLE = "#c9d2e0", WHEEL = "#8fe0ff", CONSTRAINT = "#9be564";

function triad({ length, position, quaternion }) {
  const group = new THREE.Group();
  [[0xff5a52, [1, 0, 0]], [0x5fd068, [0, 1, 0]], [0x4c8dff, [0, 0, 1]]].forEach(([colour, axis]) => {
    const one = arrow(colour, 0.022 * length);
    one.setLength(length);
    one.quaternion.setFromUnitVectors(UP, new THREE.Vector3(...axis));
    group.add(one);
  });
  group.position.set(...position);
  group.quaternion.set(...quaternion);
  return group;
}

// A bell that opens against the push.
function nozzle({ position, direction }, size) {
  const length = 0.035 * size;
  const material = once("nozzle", () => new THREE.MeshStandardMaterial({ color: NOZZLE, metalness: 0.8, roughness: 0.35, side: THREE.DoubleSide }));
  const bell = new THREE.Mesh(new THREE.CylinderGeometry(0.3 * length, 0.6 * length, length, 24, 1, true).translate(0, -length / 2, 0), material);
  bell.castShadow = true;
  const group = new THREE.Group();
  group.add(bell);
  group.position.set(...position);
  group.quaternion.setFromUnitVectors(UP, new THREE.Vector3(...direction));
  return group;
}

// A rim with spokes about z, seen through the body; it turns as the wheel does, if that is a state.
function wheel({ position, quaternion, spins, path }, size, viewer) {
  const radius = 0.05 * size, material = seenThrough(WHEEL);
  material.opacity = 0.7;
  const group = new THREE.Group(), thin = 0.08 * radius;
  group.add(new THREE.Mesh(new THREE.TorusGeometry(radius, 1.5 * thin, 10, 40), material));
  for (const angle of [0, 1, 2]) {
    const spoke = new THREE.Mesh(new THREE.CylinderGeometry(thin, thin, 2 * radius, 8), material);
    spoke.rotation.z = (angle * Math.PI) / 3;
    group.add(spoke);
  }
  group.children.forEach((each) => { each.renderOrder = 5; });
  group.position.set(...position);
  group.quaternion.set(...quaternion);
  if (spins) {
    const [carrier, rotor] = [path, spins].map((each) => viewer.scene_tree.find(each).object);
    group.show = () => group.quaternion.copy(carrier.quaternion).invert().multiply(rotor.quaternion);
  }
  return group;
}

// A magnetorquer: a core with its winding, seen through the body.
function rod({ position, axis }, size) {
  const length = 0.34 * size, radius = 0.009 * size;
  const group = new THREE.Group(), core = seenThrough(MARKS.moment), winding = seenThrough(MARKS.moment);
  core.opacity = 0.45;
  winding.opacity = 0.6;
  group.add(new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, length, 16), core));
  for (let k = -3; k <= 3; k++) {
    const ring = new THREE.Mesh(new THREE.TorusGeometry(1.5 * radius, 0.45 * radius, 8, 24), winding);
    ring.rotation.x = Math.PI / 2;
    ring.position.y = 0.11 * k * length;
    group.add(ring);
  }
  group.children.forEach((each) => { each.renderOrder = 5; });
  group.position.set(...position);
  group.quaternion.setFromUnitVectors(UP, new THREE.Vector3(...axis));
  return group;
}

// A bolt for a weld, a ring with its pin along z for a hinge, a ball in its socket for a spherical.
function constraint({ kind, position, quaternion, active }, size) {
  const r = 0.022 * size, group = new THREE.Group(), material = seenThrough(CONSTRAINT);
  material.opacity = 0.85;
  const add = (geometry) => {
    const mesh = new THREE.Mesh(geometry, material);
    mesh.renderOrder = 5;
    group.add(mesh);
  };
  const rod = (radius, length, sides) => new THREE.CylinderGeometry(radius, radius, length, sides).rotateX(Math.PI / 2);
  if (kind === "weld") {
    add(rod(r, 0.7 * r, 6).translate(0, 0, 0.6 * r));
    add(rod(0.45 * r, 2 * r, 16).translate(0, 0, -0.6 * r));
  } else if (kind === "hinge") {
    add(new THREE.TorusGeometry(r, 0.22 * r, 12, 40));
    add(rod(0.25 * r, 3 * r, 16));
  } else {
    add(new THREE.SphereGeometry(0.6 * r, 24, 16));
    add(new THREE.TorusGeometry(r, 0.12 * r, 10, 40));
  }
  group.position.set(...position);
  group.quaternion.set(...quaternion);
  if (active) group.show = (i) => { group.visible = i === undefined || active[i] > 0; };
  return group;
}

// Put the equipment on the robot. Returns what shows it at the poses that the bodies have in frame i.
function makeEquipment(viewer, info) {
  const shows = [];
  const add = (each, name, mark) => {
    viewer.scene_tree.find([...each.path, name]).object.add(mark);
    if (mark.show) shows.push(mark.show);
  };
  info.triads.forEach((each, k) => add(each, `frame ${k}`, triad({ ...each, length: (k ? 0.12 : 0.3) * info.size })));
  info.nozzles.forEach((each, k) => add(each, `nozzle ${k}`, nozzle(each, info.size)));
  info.wheels.forEach((each, k) => add(each, `wheel ${k}`, wheel(each, info.size, viewer)));
  info.rods.forEach((each) => add(each, `rod ${each.name}`, rod(each, info.size)));
  info.constraints.forEach((each, k) => add(each, `constraint ${k}`, constraint(each, info.size)));
  return (i) => shows.forEach((show) => show(i));
}
