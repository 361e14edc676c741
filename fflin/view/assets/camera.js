// The camera: it frames the robot in the free part of the window, from a view, and follows base or
// tool.

const FIELD_OF_VIEW = 34;

const NARROW = 700; // narrower windows have the panel under the scene [CSS pixels]
const SMALL = 520; // lower windows have a panel of two readouts and no legend [CSS pixels]

const isSmall = () => window.innerHeight < SMALL;

// Directions towards the camera, y up.
const VIEWS = { front: [1, 0, 0], side: [0, 0, 1], top: [0.001, 1, 0] };
const OVERVIEW = { space: [1, 0.5, 0.62], lab: [1, 0.36, 0.62] };

function makeCamera(viewer, info, aim) {
  const { camera, controls } = viewer, { size } = info;
  camera.fov = FIELD_OF_VIEW;
  camera.near = 0.01 * size;
  camera.far = 400 * size;
  controls.minDistance = 0.1 * size;
  controls.maxDistance = 60 * size;
  controls.enableDamping = false;

  // The part of the window that the panels leave free.
  const free = () => {
    const box = (id) => document.getElementById(id).getBoundingClientRect();
    const legend = box("legend"), panel = box("panel"), bar = box("bar");
    if (document.body.classList.contains("plain")) return { right: 0, top: 30, bottom: legend.height + 16 };
    const w = window.innerWidth, h = window.innerHeight;
    const bottom = bar.height ? h - bar.top : 70;
    if (isSmall() && document.body.matches(".motion:not(.opened)")) {
      const head = box("heading").bottom + 4;
      if (w <= NARROW) return { right: 0, top: head, bottom: (panel.height ? h - panel.top : bottom) + 4 };
      return { right: 0, top: Math.max(head, panel.bottom + 4), bottom };
    }
    if (w <= NARROW) return { right: 0, top: Math.max(64, box("heading").bottom + 4), bottom: (panel.height ? h - panel.top : bottom) + legend.height + 8 };
    return { right: panel.width ? w - panel.left : 0, top: 40, bottom };
  };
  const resize = () => {
    const bar = document.getElementById("bar"), panel = document.getElementById("panel");
    const below = bar.offsetHeight ? window.innerHeight - bar.getBoundingClientRect().top + 8 : 12;
    document.body.style.setProperty("--bar", `${below}px`);
    document.body.style.setProperty("--below", `${below + (panel.offsetHeight ? panel.offsetHeight + 8 : 0)}px`);
    viewer.set_3d_pane_size();
    const { right, top, bottom } = free();
    const w = window.innerWidth, h = window.innerHeight;
    camera.setViewOffset(w, h, right / 2, (bottom - top) / 2, w, h);
    viewer.set_dirty();
  };
  const look = (target, back, distance) => {
    controls.target.copy(target);
    camera.position.copy(target).addScaledVector(back, distance);
    controls.update();
    viewer.set_dirty();
  };
  // Stand back along a direction until every point lies within the free part of the window.
  const frame = (points, back) => {
    resize();
    const { right, top, bottom } = free();
    const side = new THREE.Vector3(0, 1, 0).cross(back).normalize();
    const up = back.clone().cross(side);
    const tall = Math.tan((FIELD_OF_VIEW / 2) * (Math.PI / 180));
    const h = window.innerHeight, w = window.innerWidth;
    const ty = (tall * Math.max(h - top - bottom, 0.2 * h)) / h * 0.90, tx = (tall * Math.max(w - right, 0.4 * w)) / h * 0.90;
    const seen = points.map((p) => [p.dot(side), p.dot(up), p.dot(back)]);
    const middle = (k) => (Math.min(...seen.map((p) => p[k])) + Math.max(...seen.map((p) => p[k]))) / 2;
    let centre = [middle(0), middle(1), middle(2)], distance = 0;
    for (let round = 0; round < 8; round++) {
      distance = 0;
      for (const p of seen) {
        const z = p[2] - centre[2];
        distance = Math.max(distance, z + Math.abs(p[0] - centre[0]) / tx, z + Math.abs(p[1] - centre[1]) / ty);
      }
      // Perspective shifts what is near; centre what is seen.
      const shift = [0, 1].map((k) => {
        const angles = seen.map((p) => (p[k] - centre[k]) / (distance - (p[2] - centre[2])));
        return ((Math.min(...angles) + Math.max(...angles)) / 2) * distance;
      });
      centre = [centre[0] + 0.7 * shift[0], centre[1] + 0.7 * shift[1], centre[2]];
    }
    look(new THREE.Vector3().addScaledVector(side, centre[0]).addScaledVector(up, centre[1]).addScaledVector(back, centre[2]), back, distance);
  };

  // Positions in the axes of the scene, and how far each moved since it was asked for last.
  const place = ({ path, position }) => {
    const { object } = viewer.scene_tree.find(path);
    return new THREE.Vector3(...position).applyQuaternion(object.quaternion).add(object.position);
  };
  const tool = info.triads[1];
  const points = { base: () => place({ path: info.base, position: [0, 0, 0] }), tool: () => place(tool) };
  const last = {}, moved = new THREE.Vector3(); // of the base, from the start
  const shiftOf = (name) => {
    const now = points[name](), shift = last[name] ? now.clone().sub(last[name]) : new THREE.Vector3();
    last[name] = now;
    return shift;
  };
  const centre = yUp(info.centre), gone = new THREE.Vector3(); // how far the camera followed the base
  // Until somebody takes the camera, it frames the robot anew in every window.
  let follow = Boolean(info.follow), view = "overview", taken = false, onTaken = () => {};
  const reframe = () => {
    const back = new THREE.Vector3(...(view === "overview" ? OVERVIEW[info.scene] : VIEWS[view]));
    frame(info.points.map((p) => yUp(new THREE.Vector3(...p).add(gone).toArray())), back.normalize());
  };
  const step = () => {
    const base = shiftOf("base");
    moved.add(base);
    const shift = view === "tool" ? shiftOf("tool") : base;
    if (view === "tool" || follow) {
      camera.position.add(yUp(shift.toArray()));
      controls.target.add(yUp(shift.toArray()));
    }
    if (follow) gone.add(base);
    centre.add(yUp(base.toArray()));
    aim(centre);
  };
  const setView = (name) => {
    if (name === "tool" && !tool) return;
    view = name;
    taken = false;
    if (info.follow) gone.copy(moved); // its points move with the base
    if (name === "tool") {
      last.tool = points.tool();
      taken = true;
      look(yUp(last.tool.toArray()), new THREE.Vector3(...OVERVIEW[info.scene]).normalize(), 0.9 * size);
    } else reframe();
  };
  const before = new THREE.Vector3();
  controls.addEventListener("start", () => before.copy(camera.position));
  controls.addEventListener("end", () => {
    if (before.equals(camera.position)) return;
    taken = true;
    onTaken();
  });
  window.addEventListener("resize", () => { resize(); if (!taken) reframe(); });
  return {
    step, setView, reframe,
    views: ["overview", ...Object.keys(VIEWS), ...(tool ? ["tool"] : [])],
    follow: (on) => { follow = on; },
    following: () => follow,
    whenTaken: (act) => { onTaken = act; },
  };
}
