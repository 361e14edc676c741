// The sky: stars, a faint band of galaxy and a planet below, drawn once into a cube; and what the
// metal of the robot mirrors of it.

const PLANET_DIP = 0.56; // angle of the planet's horizon below the horizontal [rad]

const SKY_VERTEX = `
varying vec3 direction;
void main() {
  direction = position;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

const NOISE = `
float hash(vec3 p) {
  p = fract(p * 0.3183099 + vec3(0.71, 0.113, 0.419));
  p *= 17.0;
  return fract(p.x * p.y * p.z * (p.x + p.y + p.z));
}
float noise(vec3 x) {
  vec3 i = floor(x), f = fract(x);
  f = f * f * (3.0 - 2.0 * f);
  return mix(
    mix(mix(hash(i), hash(i + vec3(1, 0, 0)), f.x), mix(hash(i + vec3(0, 1, 0)), hash(i + vec3(1, 1, 0)), f.x), f.y),
    mix(mix(hash(i + vec3(0, 0, 1)), hash(i + vec3(1, 0, 1)), f.x), mix(hash(i + vec3(0, 1, 1)), hash(i + vec3(1, 1, 1)), f.x), f.y),
    f.z);
}
float fbm(vec3 p) {
  float total = 0.0, weight = 0.5;
  for (int i = 0; i < 6; i++) {
    total += weight * noise(p);
    p = p * 2.03 + vec3(3.1, 1.7, 5.3);
    weight *= 0.5;
  }
  return total;
}
`;

// The ground of a planet, its alpha where the sea glitters; and how that is lit, with its air.
const GROUND = `
uniform vec3 sun, sea, low, high, air;
uniform float land, clouds;
vec4 ground(vec3 n) {
  vec3 place = n.zxy * 7.0 + vec3(4.0, 2.3, 8.0);
  float dry = fbm(place * 2.7 + 5.0), ashore = smoothstep(land, land + 0.06, fbm(place));
  vec3 surface = mix(sea, mix(low, high, smoothstep(0.35, 0.6, dry)), ashore);
  vec3 swirl = place * vec3(1.6, 3.4, 1.6);
  float warp = fbm(swirl * 0.8 + 9.0);
  float cloud = clouds * smoothstep(0.50, 0.80, fbm(swirl * 1.5 + 2.2 * warp) * 0.72 + 0.3 * warp);
  return vec4(mix(surface, vec3(0.78, 0.82, 0.86), cloud), (1.0 - ashore) * (1.0 - cloud));
}
vec3 lit(vec4 g, vec3 n, vec3 view) {
  float light = smoothstep(-0.10, 0.55, dot(n, sun));
  vec3 surface = g.rgb + g.a * air * vec3(2.2, 0.83, 0.3) * pow(max(dot(n, normalize(sun - view)), 0.0), 60.0);
  return light * (0.55 * surface + air * vec3(0.45, 0.52, 0.62) * (0.04 + 0.85 * pow(1.0 - max(dot(n, -view), 0.0), 3.2)));
}
vec3 rim(vec3 colour, vec3 d, float b, float miss, vec3 c) {
  float height = max(sqrt(miss) - 1.0, 0.0), over = smoothstep(0.994, 1.0, miss) * step(0.001, air.z);
  float light = smoothstep(-0.15, 0.45, dot(normalize(d * b - c), sun));
  vec3 glow = air * (0.50 * exp(-height * 230.0) + vec3(0.10, 0.12, 0.16) * exp(-height * 60.0));
  return mix(colour, (miss < 1.0 ? vec3(0.0) : colour) + light * glow, over);
}`;

const SKY_FRAGMENT = `
varying vec3 direction;
uniform float distanceToCentre;
uniform float studio;
${NOISE}
${GROUND}
void main() {
  vec3 d = normalize(direction);
  vec3 c = vec3(0.0, -distanceToCentre, 0.0);
  float b = dot(d, c);
  float miss = dot(c, c) - b * b;
  vec3 colour = mix(vec3(0.0016, 0.0022, 0.0050), vec3(0.0030, 0.0042, 0.0095), 0.5 + 0.5 * d.y);
  float band = dot(d, normalize(vec3(0.42, 0.52, 0.62)));
  if (b > 0.0 && miss < 1.0) {
    vec3 n = normalize(d * (b - sqrt(1.0 - miss)) - c);
    colour = lit(ground(n), n, d);
  } else if (abs(band) < 0.6) { // farther off it is too faint to be seen
    float milk = exp(-band * band * 22.0) * smoothstep(0.30, 0.75, fbm(d * 5.0));
    colour += milk * mix(vec3(0.010, 0.012, 0.020), vec3(0.024, 0.019, 0.020), fbm(d * 9.0 + 4.0));
  }
  if (b > 0.0) colour = rim(colour, d, b, miss, c);
  float toSun = max(dot(d, sun), 0.0);
  colour += vec3(1.0, 0.94, 0.84) * (pow(toSun, 1600.0) * 12.0 + pow(toSun, 60.0) * 0.05);
  // What only mirrors see: lamps, without which metal in a dark sky is black.
  colour += studio * (vec3(0.85, 0.90, 1.0) * 0.75 * smoothstep(0.25, 0.95, d.y)
    + vec3(1.0, 0.95, 0.86) * 2.2 * smoothstep(0.75, 0.97, dot(d, normalize(sun + vec3(0.2, 0.35, 0.0))))
    + vec3(0.55, 0.70, 1.0) * 0.40 * smoothstep(0.55, 0.98, dot(d, normalize(vec3(-sun.x, 0.15, -sun.z))))
    + vec3(0.05, 0.06, 0.08));
  gl_FragColor = vec4(colour, 1.0);
}`;

const LAB_FRAGMENT = `
varying vec3 direction;
uniform vec3 sun;
void main() {
  vec3 d = normalize(direction);
  vec3 colour = mix(vec3(0.42, 0.44, 0.47), vec3(0.80, 0.85, 0.92), smoothstep(-0.3, 0.7, d.y));
  colour += vec3(1.0, 0.97, 0.92) * 2.5 * smoothstep(0.80, 0.98, dot(d, sun));
  gl_FragColor = vec4(colour, 1.0);
}`;

function makeSky(renderer, sun, space, orbit) {
  const uniforms = {
    ...bodyUniforms(orbit ? orbit.body : "earth"),
    sun: { value: sun },
    distanceToCentre: { value: orbit ? orbit.distance : 1 / Math.cos(PLANET_DIP) },
    studio: { value: 0 },
  };
  const material = new THREE.ShaderMaterial({
    uniforms, side: THREE.BackSide, depthWrite: false,
    vertexShader: SKY_VERTEX, fragmentShader: space ? SKY_FRAGMENT : LAB_FRAGMENT,
  });
  const scene = new THREE.Scene();
  scene.add(new THREE.Mesh(new THREE.BoxGeometry(10, 10, 10), material));
  const render = (size) => {
    const target = new THREE.WebGLCubeRenderTarget(size, {
      type: THREE.HalfFloatType, format: THREE.RGBAFormat, generateMipmaps: true, minFilter: THREE.LinearMipmapLinearFilter,
    });
    const encoding = renderer.outputEncoding, mapping = renderer.toneMapping;
    renderer.outputEncoding = THREE.LinearEncoding;
    renderer.toneMapping = THREE.NoToneMapping;
    new THREE.CubeCamera(0.1, 20, target).update(renderer, scene);
    renderer.outputEncoding = encoding;
    renderer.toneMapping = mapping;
    return target.texture;
  };
  if (orbit) { // whose stars alone are of this sky
    uniforms.sun.value = new THREE.Vector3();
    uniforms.distanceToCentre.value = 1e3;
  }
  const background = space ? render(1024) : null;
  if (orbit) {
    uniforms.sun.value = sun;
    uniforms.distanceToCentre.value = orbit.distance;
  }
  uniforms.studio.value = 1;
  const mirrored = new THREE.PMREMGenerator(renderer).fromCubemap(render(128)).texture;
  return { background, environment: mirrored };
}

// A generator of its own, so that every page and every picture has the same stars.
function randomNumbers(seed) {
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

function makeStars(orbit) {
  const random = randomNumbers(7);
  const positions = [], colours = [], sizes = [];
  const lowest = orbit ? -1 : -Math.sin(PLANET_DIP) + 0.012, horizon = orbit ? -Math.sqrt(1 - orbit.distance ** -2) : -2;
  while (sizes.length < 4500) {
    const y = 2 * random() - 1, turn = 2 * Math.PI * random();
    if (y < lowest) continue;
    const r = Math.sqrt(1 - y * y);
    positions.push(r * Math.cos(turn), y, r * Math.sin(turn));
    const bright = Math.pow(random(), 7);
    const warmth = random();
    const level = 0.35 + 0.9 * bright + 0.3 * random();
    colours.push(level * (0.80 + 0.20 * warmth), level * 0.90, level * (1.0 - 0.22 * warmth));
    sizes.push(1.5 + 2.6 * bright);
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  geometry.setAttribute("size", new THREE.Float32BufferAttribute(sizes, 1));
  const material = new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, depthTest: true, blending: THREE.AdditiveBlending,
    uniforms: { ratio: { value: window.devicePixelRatio || 1 }, turned: { value: 0 }, horizon: { value: horizon } },
    vertexShader: `
      attribute vec3 color; attribute float size; uniform float ratio, turned, horizon; varying vec3 shade;
      void main() {
        float s = sin(turned), c = cos(turned);
        vec3 there = vec3(c * position.x - s * position.y, s * position.x + c * position.y, position.z);
        shade = color * step(horizon, there.y);
        vec4 p = projectionMatrix * vec4(mat3(viewMatrix) * there, 1.0);
        gl_Position = p.xyww * vec4(1.0, 1.0, 0.999999, 1.0);
        gl_PointSize = size * ratio;
      }`,
    fragmentShader: `
      varying vec3 shade;
      void main() {
        float r = length(gl_PointCoord - 0.5);
        gl_FragColor = vec4(shade * smoothstep(0.5, 0.12, r), 1.0);
      }`,
  });
  const stars = new THREE.Points(geometry, material);
  stars.frustumCulled = false;
  stars.renderOrder = -10;
  return stars;
}
