// The stage: meshcat's viewer with our light, sky and camera. The scene is z-up below a root that
// three.js turns to y-up: (x, y, z) of the scene is (x, z, -y) to the camera, or in orbit what its
// `up` says.

const upright = new THREE.Quaternion();
const yUp = ([x, y, z]) => new THREE.Vector3(x, y, z).applyQuaternion(upright);

const FIELD_OF_VIEW = 34;

function makeStage(info) {
  const viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"), false);
  window.onload = null;
  const { renderer, scene } = viewer;
  const space = info.scene === "space", orbit = info.orbit;
  const [x, y, z] = (info.up ?? [[1, 0, 0], [0, 0, 1], [0, -1, 0]]).map((row) => new THREE.Vector3(...row));
  upright.setFromRotationMatrix(new THREE.Matrix4().makeBasis(x, y, z).transpose());
  scene.quaternion.copy(upright);
  viewer.scene_tree.find(["Cameras", "default", "rotated"]).object.quaternion.copy(upright).invert(); // as meshcat does
  renderer.outputEncoding = THREE.sRGBEncoding;
  renderer.toneMapping = THREE.ACESFilmicToneMapping;
  renderer.toneMappingExposure = space ? 1.0 : 0.95;
  for (const name of ["SpotLight", "PointLightNegativeX", "PointLightPositiveX", "AmbientLight", "FillLight"]) {
    viewer.set_property(["Lights", name], "visible", false);
  }
  viewer.set_property(["Background"], "visible", false);
  viewer.set_property(["Grid"], "visible", false);
  viewer.set_property(["Axes"], "visible", false);

  const towardsSun = yUp(info.sun).normalize();
  const sky = makeSky(renderer, towardsSun, space, orbit);
  scene.background = orbit ? null : sky.background;
  scene.environment = sky.environment;

  const size = info.size;
  const sun = new THREE.DirectionalLight(0xfff3e2, space ? 2.6 : 1.6);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  sun.shadow.bias = -0.0004;
  sun.shadow.normalBias = 0.004 * size;
  const reach = 1.35 * size;
  Object.assign(sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1 * size, far: 9 * size });
  const glow = new THREE.HemisphereLight(space ? 0x9db4d8 : 0xffffff, space ? 0x2f5fae : 0xb0b4ba, space ? 0.28 : 0.35);
  const lights = new THREE.Group();
  lights.quaternion.copy(upright).invert(); // undoes the turn of the scene
  lights.add(sun, sun.target, glow);
  viewer.scene_tree.find(["Lights", "sun"]).object.add(lights);
  const aim = (centre) => {
    sun.target.position.copy(centre);
    sun.position.copy(towardsSun).multiplyScalar(5 * size).add(centre);
  };
  const stars = space ? makeStars(orbit) : null;
  const below = orbit ? makeOrbitSky(renderer, towardsSun, orbit, sky.background) : null;
  // To a time [s]: the body and the stars go back as the orbit goes on.
  const turn = (time) => {
    if (!orbit) return;
    const angle = (orbit.rate * time) % (2 * Math.PI);
    below.turn(angle);
    stars.material.uniforms.turned.value = angle;
  };
  if (orbit) scene.add(below.dome);
  if (space) scene.add(stars);
  else viewer.scene_tree.find(["Floor"]).object.add(makeFloor(info));

  const camera = viewer.camera;
  camera.fov = FIELD_OF_VIEW;
  camera.near = 0.01 * size;
  camera.far = 400 * size;
  const controls = viewer.controls;
  controls.minDistance = 0.2 * size;
  controls.maxDistance = 60 * size;
  controls.enableDamping = false;

  // The part of the window that the panels leave free.
  const free = () => {
    if (document.body.classList.contains("plain")) {
      const legend = document.getElementById("legend").getBoundingClientRect();
      return { right: 0, top: 30, bottom: legend.height + 16 };
    }
    const panel = document.getElementById("panel").getBoundingClientRect();
    const bar = document.getElementById("bar").getBoundingClientRect();
    const w = window.innerWidth, h = window.innerHeight;
    const bottom = bar.height ? h - bar.top : 70;
    if (!panel.width) return { right: 0, top: 40, bottom };
    if (panel.width < 0.6 * w) return { right: w - panel.left, top: 40, bottom };
    // In a narrow window the panel takes all of the width, above or below.
    return panel.top < 0.3 * h ? { right: 0, top: panel.bottom, bottom } : { right: 0, top: 60, bottom: h - panel.top };
  };
  const resize = () => {
    viewer.set_3d_pane_size();
    const { right, top, bottom } = free();
    const w = window.innerWidth, h = window.innerHeight;
    camera.setViewOffset(w, h, right / 2, (bottom - top) / 2, w, h);
    viewer.set_dirty();
  };
  // Until somebody takes the camera, it frames the robot anew in every window.
  let taken = false, framed = null;
  const before = new THREE.Vector3();
  controls.addEventListener("start", () => before.copy(camera.position));
  controls.addEventListener("end", () => { taken ||= !before.equals(camera.position); });
  window.addEventListener("resize", () => {
    resize();
    if (framed && !taken) frame(...framed());
  });
  const keepFramed = (what) => { framed = what; frame(...what()); };

  // Stand back along a direction until every point lies within the free part of the window.
  const frame = (points, direction) => {
    resize();
    const { right, top, bottom } = free();
    const back = yUp(direction).normalize();
    const side = new THREE.Vector3(0, 1, 0).cross(back).normalize();
    const up = back.clone().cross(side);
    const tall = Math.tan((FIELD_OF_VIEW / 2) * (Math.PI / 180));
    const h = window.innerHeight, w = window.innerWidth;
    const ty = (tall * Math.max(h - top - bottom, 0.2 * h)) / h * 0.90, tx = (tall * Math.max(w - right, 0.4 * w)) / h * 0.90;
    const seen = points.map(yUp).map((p) => [p.dot(side), p.dot(up), p.dot(back)]);
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
    const target = new THREE.Vector3().addScaledVector(side, centre[0]).addScaledVector(up, centre[1]).addScaledVector(back, centre[2]);
    controls.target.copy(target);
    camera.position.copy(target).addScaledVector(back, distance);
    controls.update();
    viewer.set_dirty();
  };
  // What comes from Python is dressed on its way in.
  const setObject = viewer.set_object.bind(viewer);
  viewer.set_object = (path, object) => { object.traverse(dress); setObject(path, object); };
  aim(new THREE.Vector3());
  viewer.animate();
  return { viewer, aim, keepFramed, turn };
}

function makeFloor(info) {
  const size = 60 * info.size;
  const floor = new THREE.Group();
  const shade = new THREE.Mesh(new THREE.PlaneGeometry(size, size), new THREE.ShadowMaterial({ opacity: 0.28, depthWrite: false }));
  shade.receiveShadow = true;
  const cell = Math.pow(10, Math.round(Math.log10(info.size / 2)));
  const lines = new THREE.Mesh(new THREE.PlaneGeometry(size, size), new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, extensions: { derivatives: true },
    uniforms: { cell: { value: cell }, reach: { value: 7 * info.size } },
    vertexShader: "varying vec2 p; void main() { p = position.xy; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
    fragmentShader: `
      varying vec2 p; uniform float cell; uniform float reach;
      float grid(float width) {
        vec2 at = p / width, near = abs(fract(at - 0.5) - 0.5) / fwidth(at);
        return 1.0 - min(min(near.x, near.y), 1.0);
      }
      void main() {
        float line = max(0.45 * grid(cell), 0.22 * grid(cell / 5.0));
        gl_FragColor = vec4(0.25, 0.33, 0.45, line * smoothstep(reach, 0.2 * reach, length(p)));
      }`,
  }));
  shade.position.z = -0.001 * info.size;
  floor.add(shade, lines);
  floor.position.set(...info.floor);
  return floor;
}
