// Materials: what a piece of the robot is made of, by the name of its URDF material.

const FINISHES = [
  [/gold|foil|mli|kapton/i, { metalness: 0.95, roughness: 0.34, foil: true, lift: 1.25 }],
  [/cell|solar/i, { metalness: 0.35, roughness: 0.24, cells: true }],
  [/silver|alumin|steel|metal|chrome|titan/i, { metalness: 0.85, roughness: 0.36 }],
  [/black|carbon|rubber/i, { metalness: 0.3, roughness: 0.5 }],
  [/joint|dark|grey|gray/i, { metalness: 0.55, roughness: 0.42 }],
  [/white|tube|light/i, { metalness: 0.05, roughness: 0.42 }],
  [/held inertia/, { metalness: 0.0, roughness: 0.8, opacity: 0.42, lift: 0.6 }],
  [/inertia/, { metalness: 0.0, roughness: 0.7, opacity: 0.55 }],
  [/./, { metalness: 0.1, roughness: 0.5 }],
  [/^$/, { metalness: 0.15, roughness: 0.5 }],
];

const GHOST_LOOK = [0x9fc4ff, 0.42]; // colour and strength
const CONTOUR = 1.7; // width [CSS pixels]

const shared = new Map(); // geometries by name, materials and textures by what they are

function once(key, make) {
  if (!shared.has(key)) shared.set(key, make());
  return shared.get(key);
}

function canvasTexture(size, draw, linear) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = size;
  draw(canvas.getContext("2d"), size);
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.anisotropy = 8;
  if (!linear) texture.encoding = THREE.sRGBEncoding;
  return texture;
}

// Heights of crumpled foil: distances to the nearest of scattered points, in three sizes.
function foilTexture() {
  const texture = canvasTexture(256, (context, size) => {
    const random = randomNumbers(3);
    const image = context.createImageData(size, size);
    const height = new Float32Array(size * size);
    for (const [count, weight] of [[8, 1.0], [40, 0.45], [120, 0.2]]) {
      const points = Array.from({ length: count }, () => [random() * size, random() * size]);
      const scale = weight / (size / Math.sqrt(count));
      for (let y = 0; y < size; y++) for (let x = 0; x < size; x++) {
        let nearest = Infinity;
        for (const [px, py] of points) {
          let dx = Math.abs(x - px), dy = Math.abs(y - py);
          dx = Math.min(dx, size - dx); dy = Math.min(dy, size - dy);
          nearest = Math.min(nearest, dx * dx + dy * dy);
        }
        height[y * size + x] += scale * Math.sqrt(nearest);
      }
    }
    for (let i = 0; i < height.length; i++) {
      const level = Math.min(255, 150 * height[i]);
      image.data.set([level, level, level, 255], 4 * i);
    }
    context.putImageData(image, 0, 0);
  }, true);
  texture.repeat.set(1.25, 1.25);
  return texture;
}

function cellTexture(colour) {
  const texture = canvasTexture(256, (context, size) => {
    const base = `#${colour.getHexString()}`;
    context.fillStyle = base;
    context.fillRect(0, 0, size, size);
    const half = size / 2;
    for (const [x, y] of [[0, 0], [half, 0], [0, half], [half, half]]) {
      const fade = context.createLinearGradient(x, y, x + half, y + half);
      fade.addColorStop(0, "rgba(110,150,255,0.20)");
      fade.addColorStop(1, "rgba(0,0,30,0.30)");
      context.fillStyle = fade;
      context.fillRect(x + 2, y + 2, half - 4, half - 4);
      context.fillStyle = "rgba(190,205,235,0.30)";
      for (const f of [0.3, 0.7]) context.fillRect(x + f * half, y, 1, half);
      context.strokeStyle = "rgba(200,210,235,0.55)";
      context.lineWidth = 2.5;
      context.strokeRect(x, y, half, half);
    }
  });
  texture.repeat.set(3.2, 3.2);
  return texture;
}

function realMaterial(about) {
  const [r, g, b, a] = about.color;
  const finish = FINISHES.find(([pattern]) => pattern.test(about.finish))[1];
  return once(`material ${about.color} ${about.finish}`, () => {
    const colour = new THREE.Color(r, g, b);
    const linear = colour.clone().convertSRGBToLinear().multiplyScalar(finish.lift || 1);
    const alpha = a * (finish.opacity || 1);
    const material = new THREE.MeshStandardMaterial({
      color: linear, metalness: finish.metalness, roughness: finish.roughness,
      transparent: alpha < 1, opacity: alpha, side: THREE.DoubleSide, envMapIntensity: 0.9,
    });
    if (finish.foil) {
      material.bumpMap = once("foil", foilTexture);
      material.bumpScale = 0.02; material.envMapIntensity = 1.5;
    }
    if (finish.cells) {
      material.color.set(0xffffff);
      material.map = once(`cells ${about.color}`, () => cellTexture(colour));
    }
    return material;
  });
}

// Brightest where the surface turns away, as glass does.
function ghostMaterial() {
  const [colour, strength] = GHOST_LOOK;
  return once("ghost", () => new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, side: THREE.FrontSide,
    polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 4,
    uniforms: { colour: { value: new THREE.Color(colour) }, strength: { value: strength } },
    vertexShader: `
      varying vec3 normalInView; varying vec3 toEye;
      void main() {
        vec4 p = modelViewMatrix * vec4(position, 1.0);
        normalInView = normalMatrix * normal; toEye = -p.xyz;
        gl_Position = projectionMatrix * p;
      }`,
    fragmentShader: `
      uniform vec3 colour; uniform float strength;
      varying vec3 normalInView; varying vec3 toEye;
      void main() {
        float facing = abs(dot(normalize(normalInView), normalize(toEye)));
        float rim = pow(1.0 - facing, 2.0);
        gl_FragColor = vec4(colour, strength * (0.16 + 0.84 * rim));
      }`,
  }));
}

// A contour: of the piece itself only the depth is drawn, and of its back faces, moved outwards by
// the width of the line, what lies beside it.
function contoured(object) {
  const depth = once("depth alone", () => new THREE.MeshBasicMaterial({ colorWrite: false, transparent: true }));
  const line = once("contour", () => new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, side: THREE.BackSide,
    polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 4,
    uniforms: { colour: { value: new THREE.Color(LINEAR) }, pixel: { value: new THREE.Vector2(1, 1) } },
    vertexShader: `
      uniform vec2 pixel; // of the screen, in normalised coordinates
      void main() {
        vec4 p = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
        vec2 n = (projectionMatrix * vec4(normalMatrix * normal, 0.0)).xy / pixel;
        p.xy += ${CONTOUR.toFixed(1)} * normalize(n + 1e-9) * pixel * p.w;
        gl_Position = p;
      }`,
    fragmentShader: "uniform vec3 colour; void main() { gl_FragColor = vec4(colour, 0.95); }",
  }));
  const beside = new THREE.Mesh(object.geometry, line);
  object.material = depth;
  object.renderOrder = 3;
  beside.renderOrder = 4;
  object.add(beside);
}

// Texture coordinates of a box in metres, so that a pattern has one size on all boxes.
function metricBox(geometry) {
  const { width, height, depth } = geometry.parameters;
  const sides = [[depth, height], [depth, height], [width, depth], [width, depth], [width, height], [width, height]];
  const uv = geometry.attributes.uv;
  sides.forEach(([a, b], side) => {
    for (let i = 4 * side; i < 4 * side + 4; i++) uv.setXY(i, (uv.getX(i) - 0.5) * a, (uv.getY(i) - 0.5) * b);
  });
}

// Normals that keep the edges of machined parts: a corner takes the mean of the faces about its
// vertex that are turned from its own by less than this.
const CREASE = Math.cos(0.6);

function creased(geometry) {
  const index = geometry.index.array, points = geometry.attributes.position.array;
  const faces = index.length / 3;
  const normals = new Float32Array(3 * faces);
  const around = new Map();
  const a = new THREE.Vector3(), b = new THREE.Vector3(), c = new THREE.Vector3();
  for (let f = 0; f < faces; f++) {
    a.fromArray(points, 3 * index[3 * f]); b.fromArray(points, 3 * index[3 * f + 1]); c.fromArray(points, 3 * index[3 * f + 2]);
    b.sub(a); c.sub(a); b.cross(c).toArray(normals, 3 * f);
    for (let k = 0; k < 3; k++) {
      const vertex = index[3 * f + k];
      if (!around.has(vertex)) around.set(vertex, []);
      around.get(vertex).push(f);
    }
  }
  const position = new Float32Array(9 * faces), normal = new Float32Array(9 * faces);
  for (let f = 0; f < faces; f++) {
    a.fromArray(normals, 3 * f);
    const length = a.length();
    for (let k = 0; k < 3; k++) {
      const vertex = index[3 * f + k];
      c.set(0, 0, 0);
      for (const other of around.get(vertex)) {
        b.fromArray(normals, 3 * other);
        if (a.dot(b) >= CREASE * length * b.length()) c.add(b);
      }
      c.normalize().toArray(normal, 9 * f + 3 * k);
      position.set(points.subarray(3 * vertex, 3 * vertex + 3), 9 * f + 3 * k);
    }
  }
  const result = new THREE.BufferGeometry();
  result.setAttribute("position", new THREE.BufferAttribute(position, 3));
  result.setAttribute("normal", new THREE.BufferAttribute(normal, 3));
  return result;
}

// Give a piece that has just come its geometry and its material.
function dress(object) {
  const about = object.userData;
  if (!object.isMesh || !about || !about.look) return;
  if (about.mesh) {
    if (object.geometry.type === "SphereGeometry") object.geometry = shared.get(`mesh ${about.mesh}`);
    else shared.set(`mesh ${about.mesh}`, object.geometry = creased(object.geometry));
  } else if (object.geometry.type === "BoxGeometry") {
    metricBox(object.geometry);
  }
  const real = about.look === "real" || about.look === "held";
  // A body of which the inertia alone is known has a colour of its own, and edges.
  const body = about.look === "held" && about.finish === "inertia";
  if (body) {
    Object.assign(about, { finish: "held inertia", color: [...new THREE.Color(HELD).toArray(), 1] });
    const lines = new THREE.LineBasicMaterial({ color: new THREE.Color(HELD).convertSRGBToLinear() });
    object.add(new THREE.LineSegments(new THREE.EdgesGeometry(object.geometry), lines));
  }
  object.castShadow = object.receiveShadow = real;
  if (about.look === "linear") return contoured(object);
  object.material = real ? realMaterial(about) : ghostMaterial();
  object.renderOrder = real ? 0 : 2;
}
