// While a motion plays slowly, it is drawn with fewer pixels, without new shadows, with the coarse
// meshes of the target, and at last without reflections. What stands still is drawn in full.

const SLOW = 90, FRAMES = 5; // mean of so many frames [ms] above which the quality is lowered
const LONG = 1200; // frames [ms] that are judged though they are fewer than that
const PIXELS = [1, 0.7, 0.5, 0.35]; // of each level, as a fraction along a side
const COARSE = 2; // level from which on meshes are coarse
const MATT = 3; // level from which on nothing is reflected

// A material of the same colour that only scatters light.
function mattMaterial({ uuid, color, map, side, transparent, opacity }) {
  return once(`matt ${uuid}`, () => new THREE.MeshLambertMaterial({ color, map, side, transparent, opacity }));
}

function makeQuality(viewer) {
  const { renderer } = viewer, ratio = renderer.getPixelRatio();
  const state = { level: 0, lowered: false };
  let frames = [];
  const meshes = [], reflecting = [];
  viewer.scene_tree.find(["meshcat", "robot"]).object.traverse((object) => {
    const few = object.isMesh && shared.get(`mesh ${object.userData.coarse}`);
    if (few) meshes.push({ object, full: object.geometry, few });
    if (object.isMesh && object.material.isMeshStandardMaterial) reflecting.push({ object, shiny: object.material });
  });
  const apply = (level) => {
    for (const { object, full, few } of meshes) object.geometry = level >= COARSE ? few : full;
    for (const { object, shiny } of reflecting) object.material = level >= MATT ? mattMaterial(shiny) : shiny;
    renderer.setPixelRatio(ratio * PIXELS[level]);
    renderer.shadowMap.autoUpdate = level === 0;
    renderer.shadowMap.needsUpdate = true;
    viewer.set_dirty();
  };
  // Tell how long [ms] a frame took while the motion plays.
  const measure = (time) => {
    if (state.level && !state.lowered) apply(state.level);
    state.lowered = state.level > 0;
    frames.push(time);
    const sum = frames.reduce((a, b) => a + b), mean = sum / frames.length;
    if (frames.length < (sum > LONG ? 2 : FRAMES)) return;
    frames = [];
    if (mean <= SLOW || state.level === PIXELS.length - 1) return;
    state.level++;
    state.lowered = true;
    apply(state.level);
  };
  // The motion stands still: draw it in full.
  const rest = () => {
    frames = [];
    if (state.lowered) apply(0);
    state.lowered = false;
  };
  return { measure, rest, state };
}
