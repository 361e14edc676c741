// The stage: meshcat's viewer with our light and sky. The scene is z-up below a root that
// three.js turns to y-up: (x, y, z) of the scene is (x, z, -y) to the camera, or in orbit what its
// `up` says.

// Direction to the sun, in the axes of the screen.
const SUN = [0.62, 0.62, 0.78];

// Mirrors show lamps of the sky, which are darker in the shadow, but not dark.
function dim(scene, lit) {
  scene.traverse(({ material }) => {
    if (!material || material.envMapIntensity === undefined) return;
    material.userData.mirrors ??= material.envMapIntensity;
    material.envMapIntensity = material.userData.mirrors * (0.4 + 0.6 * lit);
  });
}

const upright = new THREE.Quaternion();
const yUp = ([x, y, z]) => new THREE.Vector3(x, y, z).applyQuaternion(upright);

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

  const towardsSun = new THREE.Vector3(...SUN).normalize();
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
  const firstSun = towardsSun.clone(), screenNormal = new THREE.Vector3(0, 0, 1);
  const [full, soft] = [sun.intensity, glow.intensity];
  let dimmed = 1, fixed = false; // whether the sun goes back with the stars; else it stays, and lights the robot
  const turn = (time) => {
    if (!orbit) return;
    const angle = angleAt(orbit, time) % (2 * Math.PI), distance = distanceAt(orbit, time);
    below.turn(angle, distance);
    const { turned, horizon } = stars.material.uniforms;
    turned.value = angle;
    horizon.value = -Math.sqrt(1 - distance ** -2);
    towardsSun.copy(firstSun);
    if (fixed) towardsSun.applyAxisAngle(screenNormal, angle);
    const lit = fixed ? sunlit(towardsSun, distance) : 1;
    sun.intensity = full * lit;
    glow.intensity = soft * (0.6 + 0.4 * lit);
    if (lit !== dimmed) dim(scene, lit);
    dimmed = lit;
  };
  const shade = (on) => { fixed = on; };
  if (orbit) scene.add(below.dome);
  if (space) scene.add(stars, makeVeil());
  else viewer.scene_tree.find(["Floor"]).object.add(makeFloor(info));

  // What comes from Python is dressed on its way in.
  const setObject = viewer.set_object.bind(viewer);
  viewer.set_object = (path, object) => { object.traverse(dress); setObject(path, object); };
  aim(new THREE.Vector3());
  viewer.animate();
  return { viewer, turn, shade, camera: makeCamera(viewer, info, aim) };
}

// Looked at from above, the ground is the background of all: a veil dims it.
const VEIL = 0.72; // its opacity where one looks straight down

function makeVeil() {
  const material = new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, uniforms: { opacity: { value: 0 } },
    vertexShader: "void main() { gl_Position = vec4(position.xy, 1.0, 1.0); }", // behind all else
    fragmentShader: "uniform float opacity; void main() { gl_FragColor = vec4(0.006, 0.010, 0.022, opacity); }",
  });
  const veil = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material), direction = new THREE.Vector3();
  veil.frustumCulled = false;
  veil.renderOrder = -5;
  veil.onBeforeRender = (renderer, scene, camera) => {
    const down = -camera.getWorldDirection(direction).y;
    material.uniforms.opacity.value = VEIL * THREE.MathUtils.smoothstep(down, 0.6, 0.95);
  };
  return veil;
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
