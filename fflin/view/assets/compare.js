// The linear model beside the nonlinear robot: its contour, and the strip along the time.

const APART = 3; // CSS pixels from which on the contour is shown

// Colours of a deviation that is small, visible, and beyond the validity of the linear model.
const DEVIATIONS = [["small", "#3f8fd0"], ["visible", "#e6b422"], ["beyond validity", "#e0452c"]];

// Show target and linear model only while they are seen apart from the robot.
function makeComparison(viewer, info, ghosts) {
  const pixel = shared.has("contour") ? shared.get("contour").uniforms.pixel.value : new THREE.Vector2();
  const node = (path) => viewer.scene_tree.find(path).object;
  const bodies = info.bodies.map((path, k) => {
    const [x, y, z, X, Y, Z] = info.boxes[k];
    const corners = info.boxes[k].length ? [x, X].flatMap((a) => [y, Y].flatMap((b) => [z, Z].map((c) => new THREE.Vector3(a, b, c)))) : [];
    return { robot: node(path), corners, ghosts: ghosts.map((ghost) => node([path[0], ghost, ...path.slice(2)])) };
  });
  const one = new THREE.Vector3(), other = new THREE.Vector3();
  const seen = (point, corner, object) => point.copy(corner).applyMatrix4(object.matrixWorld).project(viewer.camera);
  const apart = (k) => bodies.some(({ robot, corners, ghosts: nodes }) => corners.some((corner) => {
    seen(one, corner, robot);
    seen(other, corner, nodes[k]);
    return Math.hypot((one.x - other.x) * window.innerWidth, (one.y - other.y) * window.innerHeight) / 2 > APART;
  }));
  const render = viewer.render.bind(viewer);
  viewer.render = () => {
    viewer.controls.update();
    viewer.scene.updateMatrixWorld();
    ghosts.forEach((_, k) => {
      const shown = apart(k);
      for (const body of bodies) body.ghosts[k].visible = shown;
    });
    pixel.set(2 / window.innerWidth, 2 / window.innerHeight);
    render();
  };
}

const kindOf = (value, levels) => levels.filter((level) => value > level).length;

// A strip below the slider, coloured by how far the linear prediction is off at each time.
function makeStrip(slider, t, values, levels) {
  const strip = element("canvas", { className: "deviation", width: 512, height: 1 });
  const percent = levels.map((level) => `${100 * level} %`);
  strip.title = `deviation of the linear model: small up to ${percent[0]}, visible, beyond validity from ${percent[1]}`;
  const context = strip.getContext("2d"), first = t[0], duration = t[t.length - 1] - first || 1;
  // Each column has the largest deviation of its time.
  const columns = new Array(strip.width).fill(-1);
  t.forEach((time, i) => {
    const next = t[Math.min(i + 1, t.length - 1)], last = strip.width - 1;
    const [from, to] = [time, next].map((at) => Math.floor(((at - first) / duration) * last));
    for (let k = from; k <= to; k++) columns[k] = Math.max(columns[k], kindOf(values[i], levels));
  });
  columns.forEach((kind, k) => {
    context.fillStyle = DEVIATIONS[Math.max(kind, 0)][1];
    context.fillRect(k, 0, 1, 1);
  });
  slider.parentNode.append(strip);
}
