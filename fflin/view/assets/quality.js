// While a motion plays slowly, it is drawn with fewer pixels, without new shadows, and at last with
// the coarse meshes of the target. What stands still is drawn in full.

const SLOW = 90, FRAMES = 5; // mean of so many frames [ms] above which the quality is lowered
const PIXELS = [1, 0.7, 0.5, 0.35]; // of each level, as a fraction along a side
const COARSE = 2; // level from which on meshes are coarse

function makeQuality(viewer) {
  const { renderer } = viewer, ratio = renderer.getPixelRatio();
  const state = { level: 0, lowered: false };
  let frames = [];
  const meshes = [];
  viewer.scene_tree.find(["meshcat", "robot"]).object.traverse((object) => {
    const few = object.isMesh && shared.get(`mesh ${object.userData.coarse}`);
    if (few) meshes.push({ object, full: object.geometry, few });
  });
  const apply = (level) => {
    for (const { object, full, few } of meshes) object.geometry = level >= COARSE ? few : full;
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
    if (frames.length < FRAMES) return;
    const mean = frames.reduce((a, b) => a + b) / frames.length;
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
