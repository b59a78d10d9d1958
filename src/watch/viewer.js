// The replay page of `handful watch`: one recorded episode of a robot arm, in 3D.
//
// Read it top-down: the recording, the clock, the scene, the ribbons (trail and
// plans), the readouts, the controls, and last the loop that joins them.
// The world is as recorded: z up, metres, quaternions in the order x y z w.

const $ = (id) => document.getElementById(id);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// ---------------------------------------------------------------- the recording

const { bodies, frames, dt, camera: view, paths: plans = [] } = JSON.parse($("recording").textContent);

const last = Math.max(frames.length - 1, 0);
const rewards = frames.map((frame) => frame.reward ?? 0);
let sum = 0;
const returns = rewards.map((reward) => (sum += reward));

// ---------------------------------------------------------------- the clock

// The whole page is a function of `cursor`: where we are, in frames, with a fraction.
let cursor = 0;
let playing = false;
let looping = true;
let speed = 1;
let rest = 0; // seconds spent on the last frame, so that a loop lets us see how it ended
let stale = true; // something changed since we last drew

const step = () => Math.min(Math.floor(cursor + 1e-6), last);

function advance(seconds) {
  cursor = Math.min(cursor + (seconds * speed) / dt, last);
  if (cursor === last) {
    rest += seconds;
    if (!looping) setPlaying(false);
    else if (rest > 0.8) seek(0);
  }
  stale = true;
}

function seek(to) {
  cursor = clamp(to, 0, last);
  rest = 0;
  stale = true;
}

function stepBy(count) {
  setPlaying(false);
  seek((count > 0 ? step() : Math.ceil(cursor - 1e-6)) + count);
}

function setPlaying(on) {
  playing = on && last > 0;
  if (playing && cursor === last) seek(0);
  $("play").dataset.playing = playing;
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
}

// Where a body is between two frames: positions in a straight line, rotations by the shortest turn.
const turn = new THREE.Quaternion();
function pose(body, at, position, rotation) {
  const before = Math.min(Math.floor(at), last);
  const from = frames[before].poses[body];
  const to = frames[Math.min(before + 1, last)].poses[body];
  const share = at - before;
  position.set(...from.slice(0, 3).map((x, axis) => x + (to[axis] - x) * share));
  rotation?.set(...from.slice(3)).slerp(turn.set(...to.slice(3)), share).normalize();
}

// ---------------------------------------------------------------- the scene

// three.js stands its capsules and cylinders along y; the recording has them along z.
const upright = (geometry) => geometry.rotateX(Math.PI / 2);
const geometries = {
  // A bevel of at most 3 mm: no real edge is perfectly sharp, and light shows it.
  box: ({ half: [x, y, z] }) => new THREE.RoundedBoxGeometry(2 * x, 2 * y, 2 * z, 2, Math.min(x / 4, y / 4, z / 4, 0.003)),
  capsule: ({ radius, half_length: h }) => upright(new THREE.CapsuleGeometry(radius, 2 * h, 12, 32)),
  cylinder: ({ radius, half_length: h }) => upright(new THREE.CylinderGeometry(radius, radius, 2 * h, 48)),
  ball: ({ radius }) => new THREE.SphereGeometry(radius, 40, 24),
};

function makeBody({ color = "#c4cad2", kind, shapes }) {
  const goal = kind === "goal"; // a goal is a place, not a thing: light passes through it
  const material = new THREE.MeshStandardMaterial({ color, roughness: 0.55 });
  if (goal) Object.assign(material, { transparent: true, depthWrite: false, emissive: new THREE.Color(color) });
  const group = new THREE.Group();
  for (const shape of shapes) {
    const mesh = new THREE.Mesh(geometries[shape.kind](shape), material);
    mesh.position.set(...shape.pose.slice(0, 3));
    mesh.quaternion.set(...shape.pose.slice(3));
    mesh.castShadow = mesh.receiveShadow = !goal;
    group.add(mesh);
  }
  return Object.assign(group, { material, goal });
}

// A grid of 20 cm cells on the floor, cut into short lines so that it can fade with distance.
function makeGrid(centre) {
  const [cell, reach] = [0.2, 12];
  const [x0, y0] = [centre.x, centre.y].map((x) => Math.round(x / cell) * cell);
  const points = [], colors = [];
  const add = (i, j) => {
    points.push(x0 + i * cell, y0 + j * cell, 0);
    colors.push(1, 1, 1, Math.max(0, 1 - Math.hypot(i, j) / reach) * 0.5);
  };
  for (let i = -reach; i <= reach; i++)
    for (let j = -reach; j < reach; j++) add(i, j), add(i, j + 1), add(j, i), add(j + 1, i);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors, 4));
  const look = { vertexColors: true, transparent: true, depthWrite: false, toneMapped: false };
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial(look));
}

function makeStage() {
  const canvas = $("canvas");
  // We ask for WebGL ourselves, because three.js would throw where we want a kind word.
  const context = canvas.getContext("webgl2", { alpha: true, antialias: true });
  if (!context) return notice("This browser cannot show the 3D view (WebGL 2 is missing or turned off). The curve and the numbers still work.");

  const renderer = new THREE.WebGLRenderer({ canvas, context, alpha: true });
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = THREE.PCFShadowMap;

  const scene = new THREE.Scene();
  const groups = bodies.map(makeBody);
  scene.add(...groups);
  const stage = { renderer, scene, groups };
  placeBodies(stage);

  const eye = new THREE.Vector3(...view.eye), target = new THREE.Vector3(...view.target);
  stage.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 50);
  stage.camera.up.set(0, 0, 1);
  stage.camera.position.copy(eye);
  stage.orbit = new THREE.OrbitControls(stage.camera, canvas);
  Object.assign(stage.orbit, { enableDamping: true, dampingFactor: 0.12, minDistance: 0.15, maxDistance: 8 });
  stage.orbit.target.copy(target);
  stage.orbit.update();
  stage.orbit.saveState();

  // One soft sky, and one sun over the viewer's left shoulder wherever the recording puts the viewer.
  const box = new THREE.Box3();
  for (const group of groups) box.expandByObject(group);
  const centre = box.getCenter(new THREE.Vector3());
  const reach = clamp(box.getSize(new THREE.Vector3()).length() / 2 + 0.3, 0.5, 2.5);
  const sky = new THREE.HemisphereLight("#ffffff", "#aab0ba", 2.1);
  sky.position.set(0, 0, 1);
  const sun = new THREE.DirectionalLight("#fff6ea", 1.6);
  const aside = eye.clone().sub(target).setZ(0).normalize().applyAxisAngle(stage.camera.up, -0.8);
  sun.position.copy(centre).addScaledVector(aside, 1.6).add(new THREE.Vector3(0, 0, 3));
  sun.target.position.copy(centre);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  Object.assign(sun.shadow, { radius: 7, normalBias: 0.004, bias: -0.0004 });
  Object.assign(sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1, far: 8 });
  scene.add(sky, sun, sun.target);

  // The floor itself is the page's background: only the shadow and the grid are drawn on it.
  const floor = new THREE.Mesh(new THREE.CircleGeometry(4, 48), new THREE.ShadowMaterial({ opacity: 0.22, depthWrite: false }));
  floor.position.set(centre.x, centre.y, -0.002);
  floor.receiveShadow = true;
  stage.grid = makeGrid(centre);
  scene.add(floor, stage.grid);

  stage.ribbons = makeRibbons();
  scene.add(stage.ribbons.mesh);
  return stage;
}

function placeBodies({ groups }) {
  groups.forEach((group, body) => {
    pose(body, cursor, group.position, group.quaternion);
    // The goal breathes by the episode's clock, so that a paused replay is really still.
    const breath = group.goal ? 0.5 - 0.5 * Math.cos((cursor * dt * 2 * Math.PI) / 1.6) : 0;
    if (group.goal) Object.assign(group.material, { opacity: 0.4 + 0.2 * breath, emissiveIntensity: 0.3 + 0.5 * breath });
  });
}

// ---------------------------------------------------------------- trail and plans

// WebGL lines are one pixel wide, so the lines here are ribbons that face the camera.
function makeRibbons() {
  const trailPoints = 48;
  const points = Math.max(0, ...plans.map((plan) => plan.reduce((n, path) => n + path.points.length, 0))) + trailPoints;
  const attribute = (size) => new THREE.BufferAttribute(new Float32Array(points * 2 * size), size).setUsage(THREE.DynamicDrawUsage);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", attribute(3));
  geometry.setAttribute("color", attribute(4));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(points * 6), 1).setUsage(THREE.DynamicDrawUsage));
  const look = { vertexColors: true, transparent: true, depthWrite: false, toneMapped: false, side: THREE.DoubleSide };
  const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial(look));
  mesh.frustumCulled = false;
  mesh.renderOrder = 1;
  const trail = Array.from({ length: trailPoints }, () => new THREE.Vector3());
  return { mesh, trail, color: new THREE.Color() };
}

// The middle of the "plasma" map: it keeps its order in grey, and shows on light and on dark.
const map = ["#46039f", "#7201a8", "#9c179e", "#bd3786", "#d8576b", "#ed7953", "#fb9f3a"].map((c) => new THREE.Color(c));
function valueColor(value) {
  const x = clamp(value, 0, 1) * (map.length - 1), i = Math.min(Math.floor(x), map.length - 2);
  return map[i].clone().lerp(map[i + 1], x - i);
}

const hand = bodies.findIndex((body) => body.name === "hand");
const widest = plans.flat().reduce((most, { spread = 0 }) => Math.max(most, spread), 1e-9);
const fans = plans.map((plan) =>
  [...plan]
    .sort((a, b) => a.value - b.value) // the best is drawn last, on top
    .map(({ points, value, spread = 0 }) => ({
      points: points.map((point) => new THREE.Vector3(...point)),
      color: valueColor(value),
      alpha: 0.95 - 0.85 * (spread / widest),
      pixels: 1.5 + 1.5 * clamp(value, 0, 1),
    })),
);
// While an action is held, or the next one of a plan executed, nothing is planned: the last plan is shown until the next.
fans.forEach((fan, i) => {
  if (fan.length === 0 && i > 0) fans[i] = fans[i - 1];
});

function drawRibbons({ ribbons, camera, renderer }) {
  const { position, color: colors } = ribbons.mesh.geometry.attributes;
  const index = ribbons.mesh.geometry.index;
  const pixel = (2 * Math.tan((camera.fov * Math.PI) / 360)) / renderer.domElement.clientHeight; // at one metre
  const along = new THREE.Vector3(), toEye = new THREE.Vector3();
  let vertex = 0, corner = 0;

  function ribbon(points, color, alpha, pixels) {
    points.forEach((point, i) => {
      along.subVectors(points[Math.min(i + 1, points.length - 1)], points[Math.max(i - 1, 0)]);
      toEye.subVectors(camera.position, point);
      const half = (toEye.length() * pixel * pixels(i)) / 2;
      const side = along.cross(toEye).normalize().multiplyScalar(half);
      for (const sign of [-1, 1]) {
        position.setXYZ(vertex, point.x + sign * side.x, point.y + sign * side.y, point.z + sign * side.z);
        colors.setXYZW(vertex++, color.r, color.g, color.b, alpha(i));
      }
      if (i > 0) for (const back of [4, 3, 2, 2, 3, 1]) index.setX(corner++, vertex - back);
    });
  }

  for (const { points, color, alpha, pixels } of fans[step()] ?? []) ribbon(points, color, () => alpha, () => pixels);

  if (hand >= 0) { // the last second of the hand's way, thinner and fainter the longer ago
    const { trail } = ribbons, newest = trail.length - 1;
    trail.forEach((point, i) => pose(hand, Math.max(0, cursor - (1 - i / newest) / dt), point));
    ribbon(trail, ribbons.color, (i) => 0.9 * Math.sqrt(i / newest), (i) => 1 + 5 * (i / newest));
  }
  ribbons.mesh.geometry.setDrawRange(0, corner);
  for (const changed of [position, colors, index]) changed.needsUpdate = true;
}

// ---------------------------------------------------------------- the readouts

const [low, high] = [Math.min(0, ...rewards), Math.max(1e-6, ...rewards)];
const width = Math.max(last, 1);
const curveY = (reward) => 1 - (reward - low) / (high - low);
const actions = Math.max(0, ...frames.map((frame) => frame.action?.length ?? 0));
const strongest = Math.max(1, ...frames.flatMap((frame) => (frame.action ?? []).map(Math.abs)));

function makeReadouts() {
  $("steps").textContent = `/ ${last}`;
  $("action").hidden = actions === 0;
  $("bars").innerHTML = Array.from({ length: actions }, (_, i) => `<div><span><b></b></span>${i + 1}</div>`).join("");

  // A frame that counts as success is shaded half a step to either side; a lone frame fills the graph.
  const half = last > 0 ? 0.5 : 1;
  const shade = frames.map(({ success }, i) => {
    const [from, to] = [Math.max(i - half, 0), Math.min(i + half, width)];
    return success ? `M${from} 0H${to}V1H${from}z` : "";
  });
  const line = rewards.map((reward, i) => `${i},${curveY(reward)}`);
  $("curve").setAttribute("viewBox", `0 0 ${width} 1`);
  $("curve").setAttribute("aria-label", `Reward at each step, from ${low.toFixed(2)} to ${high.toFixed(2)}`);
  $("curve").innerHTML = `<path class="success" d="${shade.join("")}" shape-rendering="crispEdges"/><path class="zero" d="M0 ${curveY(0)}H${width}"/>
    <polyline class="reward" points="${line.join(" ")}"/><path class="cursor"/><path class="dot"/>`;
  const first = frames.findIndex((frame) => frame.success);
  $("range").textContent = `reward per step, ${low.toFixed(2)} to ${high.toFixed(2)}`;
  $("shaded").hidden = first < 0;
  $("shaded").textContent = `success at ${(first * dt).toFixed(2)} s`;

  $("scrub").max = width;
  for (const id of ["scrub", "play", "back", "next", "loop"]) $(id).disabled = last === 0;
  $("legend").hidden = $("canvas").hidden || !plans.some((plan) => plan.length > 0);
  $("legend").querySelector("i").style.background = `linear-gradient(90deg, ${map.map((c) => c.getStyle())})`;
}

let shown = -1; // the step whose numbers stand on the page
function drawReadouts() {
  const before = Math.floor(cursor), after = Math.min(before + 1, last);
  const y = curveY(rewards[before] + (rewards[after] - rewards[before]) * (cursor - before));
  $("curve").querySelector(".cursor").setAttribute("d", `M${cursor} 0V1`);
  $("curve").querySelector(".dot").setAttribute("d", `M${cursor} ${y}h0`); // a line of no length with round ends: a dot
  $("time").textContent = (cursor * dt).toFixed(2);
  $("scrub").value = cursor;
  $("scrub").style.setProperty("--done", `${(100 * cursor) / width}%`);

  const now = step();
  if (now === shown) return;
  shown = now;
  const { success = false, action = [] } = frames[now];
  $("step").textContent = now;
  $("reward").textContent = rewards[now].toFixed(3);
  $("return").textContent = returns[now].toFixed(2);
  $("badge").dataset.success = success;
  $("verdict").textContent = success ? "success" : "not yet";
  $("scrub").setAttribute("aria-valuetext", `step ${now} of ${last}, ${(now * dt).toFixed(2)} seconds${success ? ", success" : ""}`);
  $("bars").setAttribute("aria-label", `action: ${action.map((a) => a.toFixed(2)).join(", ")}`);
  $("bars").querySelectorAll("b").forEach((bar, i) => (bar.style.transform = `scaleY(${(action[i] ?? 0) / strongest})`));
}

function notice(text) { // says what is wrong where the picture would be
  $("notice").textContent = text;
  $("notice").hidden = false;
  $("canvas").hidden = $("home").hidden = true;
  return null;
}

// ---------------------------------------------------------------- the controls

function listen(stage) {
  $("play").onclick = () => setPlaying(!playing);
  $("back").onclick = () => stepBy(-1);
  $("next").onclick = () => stepBy(1);
  $("loop").onclick = () => $("loop").setAttribute("aria-pressed", (looping = !looping));
  $("scrub").oninput = () => (setPlaying(false), seek($("scrub").valueAsNumber));

  for (const choice of [0.25, 0.5, 1, 2]) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: `${choice}×` });
    button.onclick = () => {
      speed = choice;
      for (const other of $("speeds").children) other.setAttribute("aria-pressed", other === button);
    };
    button.setAttribute("aria-pressed", choice === speed);
    $("speeds").append(button);
  }
  // A mouse click leaves no focus on a button: space then goes on meaning play, not "that button again".
  for (const button of document.querySelectorAll("button")) button.onmousedown = (event) => event.preventDefault();

  const point = ({ offsetX, buttons }) => {
    if (!buttons) return;
    setPlaying(false);
    seek((offsetX / $("curve").clientWidth) * width);
  };
  $("curve").onpointerdown = (event) => ($("curve").setPointerCapture(event.pointerId), point(event));
  $("curve").onpointermove = point;

  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === " " && event.target.closest("button")) return; // the focused button's own key
    const jump = event.shiftKey ? 10 : 1;
    const act = {
      " ": () => event.repeat || setPlaying(!playing),
      ArrowLeft: () => stepBy(-jump),
      ArrowRight: () => stepBy(jump),
      Home: () => (setPlaying(false), seek(0)),
      End: () => (setPlaying(false), seek(last)),
    }[event.key];
    if (act) event.preventDefault(), act();
  });

  if (!stage) return;
  $("home").onclick = () => {
    stage.orbit.enableDamping = false; // a view that is still gliding would glide on past the start
    stage.orbit.update();
    stage.orbit.reset();
    stage.orbit.enableDamping = stale = true;
  };
  $("canvas").addEventListener("webglcontextrestored", () => (stale = true));
  new ResizeObserver(([{ contentRect: { width, height } }]) => {
    if (width * height === 0) return;
    stage.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    stage.renderer.setSize(width, height, false);
    // A tall picture sees as wide as a square one: turning the phone must not cut the arm off.
    stage.camera.aspect = width / height;
    stage.camera.fov = (360 / Math.PI) * Math.atan(Math.tan(Math.PI / 9) / Math.min(stage.camera.aspect, 1));
    stage.camera.updateProjectionMatrix();
    draw(stage); // at once: setSize has wiped the picture
  }).observe($("stage"));

  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.onchange = () => {
    const css = getComputedStyle(document.documentElement);
    stage.grid.material.color.set(css.getPropertyValue("--grid").trim());
    stage.ribbons.color.set(css.getPropertyValue("--accent").trim());
    stale = true;
  };
  dark.onchange();
}

// ---------------------------------------------------------------- the loop

function draw(stage) {
  stale = false;
  drawReadouts();
  if (!stage) return;
  placeBodies(stage);
  drawRibbons(stage);
  stage.renderer.render(stage.scene, stage.camera);
}

if (frames.length === 0) {
  notice("This recording has no frames.");
  for (const part of document.querySelectorAll("#badge, aside, footer")) part.hidden = true;
} else {
  const stage = makeStage();
  makeReadouts();
  listen(stage);

  // "#t=1.5" at the end of the address opens the page paused at that second.
  const asked = /^#t=([\d.]+)$/.exec(location.hash);
  if (asked) seek(Number(asked[1]) / dt);
  setPlaying(!asked && !matchMedia("(prefers-reduced-motion: reduce)").matches);

  let before = performance.now();
  requestAnimationFrame(function tick(now) {
    // A page that was hidden for a minute goes on where it was: a gap counts for at most a tenth of a second.
    if (playing) advance(clamp((now - before) / 1000, 0, 0.1));
    before = now;
    if (stage?.orbit.update()) stale = true;
    if (stale) draw(stage); // nothing new, nothing drawn: a paused replay costs nothing
    requestAnimationFrame(tick);
  });
}
