// The sky of a robot in orbit: the body that it circles in its true size, which turns below it as
// the stars do. Up is away from that body, to the right is along the orbit, where one looks along
// the normal's opposite.

// Of each body: sea, low and high ground, air; how much of it is land, and how much is cloud.
const BODIES = {
  earth: [[0.006, 0.035, 0.105], [0.05, 0.10, 0.035], [0.22, 0.15, 0.08], [0.20, 0.48, 1.0], 0.50, 0.86],
  mars: [[0.10, 0.045, 0.022], [0.20, 0.085, 0.040], [0.42, 0.20, 0.095], [0.75, 0.52, 0.36], 0.40, 0.10],
  venus: [[0.55, 0.44, 0.24], [0.50, 0.38, 0.20], [0.66, 0.54, 0.32], [0.95, 0.85, 0.55], 0.45, 0.55],
  jupiter: [[0.36, 0.24, 0.15], [0.45, 0.34, 0.24], [0.58, 0.50, 0.40], [0.60, 0.50, 0.40], 0.45, 0.35],
  saturn: [[0.48, 0.40, 0.26], [0.52, 0.44, 0.30], [0.62, 0.55, 0.40], [0.70, 0.62, 0.45], 0.45, 0.30],
  rock: [[0.035, 0.034, 0.033], [0.085, 0.082, 0.078], [0.17, 0.165, 0.155], [0.0, 0.0, 0.0], 0.42, 0.0],
};
const MAP = 4096; // of the ground all the way round, as far aside as can be seen

const GROUND_FRAGMENT = `
varying vec2 at;
uniform float aside;
${NOISE}
${GROUND}
void main() {
  float lon = 6.2831853 * at.x, lat = (2.0 * at.y - 1.0) * aside;
  gl_FragColor = sqrt(clamp(ground(vec3(sin(lon) * cos(lat), cos(lon) * cos(lat), sin(lat))), 0.0, 1.0));
}`;

const ORBIT_FRAGMENT = `
varying vec3 direction;
uniform float distanceToCentre, aside, turned;
uniform samplerCube sky;
uniform sampler2D map;
${NOISE}
${GROUND}
void main() {
  vec3 d = normalize(direction), c = vec3(0.0, -distanceToCentre, 0.0);
  float s = sin(turned), k = cos(turned);
  // Cubes are left-handed.
  vec3 star = vec3(k * d.x + s * d.y, k * d.y - s * d.x, d.z);
  vec3 colour = textureCube(sky, vec3(-star.x, star.yz)).rgb;
  float b = dot(d, c), miss = dot(c, c) - b * b;
  if (b > 0.0 && miss < 1.0) {
    vec3 n = normalize(d * (b - sqrt(1.0 - miss)) - c);
    vec2 at = vec2((atan(n.x, n.y) + turned) / 6.2831853, 0.5 + 0.5 * asin(clamp(n.z, -1.0, 1.0)) / aside);
    vec4 stored = texture2D(map, at);
    stored.rgb *= 0.72 + 0.58 * fbm(90.0 * vec3(k * n.x + s * n.y, k * n.y - s * n.x, n.z)); // finer than the map
    colour = lit(stored * stored, n, d);
  }
  if (b > 0.0) colour = rim(colour, d, b, miss, c);
  float toSun = max(dot(d, sun), 0.0);
  if (b < 0.0 || miss > 1.0) colour += vec3(1.0, 0.94, 0.84) * (pow(toSun, 1600.0) * 12.0 + pow(toSun, 60.0) * 0.05);
  gl_FragColor = vec4(colour, 1.0);
  #include <tonemapping_fragment>
  #include <encodings_fragment>
}`;

function bodyUniforms(name) {
  const [sea, low, high, air, land, clouds] = BODIES[name] ?? BODIES.rock;
  const colours = Object.entries({ sea, low, high, air }).map(([key, x]) => [key, { value: new THREE.Vector3(...x) }]);
  return { ...Object.fromEntries(colours), land: { value: land }, clouds: { value: clouds } };
}

// The series of an elliptic orbit come as text.
function decodeOrbit({ orbit, t }) {
  if (!orbit || !orbit.angles) return;
  orbit.t = t;
  for (const key of ["angles", "distances"]) orbit[key] = floats(orbit[key]);
}

// A series at a time, linearly between its frames.
function between({ t }, series, time) {
  let low = 0, high = t.length - 1;
  if (high < 1) return series[0];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (t[middle] <= time) low = middle;
    else high = middle;
  }
  const part = Math.min(1, Math.max(0, (time - t[low]) / (t[high] - t[low])));
  return series[low] + part * (series[high] - series[low]);
}

// How far the orbit's axes have turned since t = 0 [rad], and the distance of the centre in radii.
const angleAt = (orbit, time) => (orbit.rate !== undefined ? orbit.rate * time : orbit.t ? between(orbit, orbit.angles, time) : 0);
const distanceAt = (orbit, time) => (orbit.t ? between(orbit, orbit.distances, time) : orbit.distance);

// The part of the sun that is seen from the orbit, 0 in the shadow; the sun is half a degree wide.
function sunlit(sun, distance) {
  const along = -distance * sun.y; // of the centre, towards the sun
  if (along < 0) return 1;
  const miss = Math.sqrt(Math.max(distance * distance - along * along, 0)), edge = 0.00465 * along;
  return THREE.MathUtils.smoothstep(miss, 1 - edge, 1 + edge);
}

function makeOrbitSky(renderer, sun, orbit, sky) {
  const aside = Math.min(1.02 * Math.acos(1 / (orbit.farthest ?? orbit.distance)), Math.PI / 2);
  const uniforms = {
    ...bodyUniforms(orbit.body), sun: { value: sun }, distanceToCentre: { value: orbit.distance },
    aside: { value: aside }, turned: { value: 0 }, sky: { value: sky }, map: { value: null },
  };
  const target = new THREE.WebGLRenderTarget(MAP, Math.min(MAP / 2, Math.ceil((MAP * aside) / Math.PI)), {
    wrapS: THREE.RepeatWrapping, minFilter: THREE.LinearMipmapLinearFilter, generateMipmaps: true,
    anisotropy: renderer.capabilities.getMaxAnisotropy(), depthBuffer: false,
  });
  const sheet = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), new THREE.ShaderMaterial({
    uniforms, fragmentShader: GROUND_FRAGMENT, depthTest: false, toneMapped: false,
    vertexShader: "varying vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }",
  }));
  sheet.frustumCulled = false;
  const flat = new THREE.Scene();
  flat.add(sheet);
  renderer.setRenderTarget(target);
  renderer.render(flat, new THREE.Camera());
  renderer.setRenderTarget(null);
  uniforms.map.value = target.texture;
  const dome = new THREE.Mesh(new THREE.BoxGeometry(2, 2, 2), new THREE.ShaderMaterial({
    uniforms, side: THREE.BackSide, depthWrite: false, fragmentShader: ORBIT_FRAGMENT,
    vertexShader: `
      varying vec3 direction;
      void main() {
        direction = position;
        gl_Position = (projectionMatrix * vec4(mat3(viewMatrix) * position, 1.0)).xyww;
      }`,
  }));
  dome.frustumCulled = false;
  dome.renderOrder = -20;
  const turn = (angle, distance) => {
    uniforms.turned.value = angle;
    uniforms.distanceToCentre.value = distance;
  };
  return { dome, turn };
}
