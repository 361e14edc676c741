// Links are named where the pointer is; a click shows the mass and the pose of one.

const STILL = 4, TAP = 10; // CSS pixels that a click and a touch may move

// A number with these decimals, never -0.
const fixed = (x, decimals) => (Number(x.toFixed(decimals)) + 0).toFixed(decimals);

function makePicking(viewer, info) {
  const pane = viewer.dom_element, overlay = document.getElementById("overlay");
  const name = element("div", { id: "hover", hidden: true }), card = element("div", { id: "link", hidden: true });
  const heading = element("b"), close = element("button", { className: "close", title: "close" }, "✕");
  const rows = element("dl"), values = {};
  for (const what of ["mass", "x, y, z", "roll, pitch, yaw"]) rows.append(element("dt", {}, what), values[what] = element("dd"));
  card.append(element("div", { className: "head" }, heading, close), rows);
  overlay.append(card, name);

  const caster = new THREE.Raycaster(), at = new THREE.Vector2();
  const seen = (object) => !object || (object.visible && seen(object.parent));
  // The mesh of a link under the pointer.
  const under = (event) => {
    const { left, top, width, height } = pane.getBoundingClientRect();
    at.set((2 * (event.clientX - left)) / width - 1, 1 - (2 * (event.clientY - top)) / height);
    caster.setFromCamera(at, viewer.camera);
    const bodies = ["robot", "held"].map((each) => viewer.scene_tree.find(["meshcat", each]).object);
    const hit = caster.intersectObjects(bodies, true).find(({ object }) => object.userData.link && seen(object));
    return hit && hit.object;
  };

  let body = null, link = null; // node of the joint, and [mass, pose on it]
  const axes = triad({ length: 0.16 * info.size, position: [0, 0, 0], quaternion: [0, 0, 0, 1] });
  axes.traverse((each) => { if (each.isMesh) Object.assign(each, { material: each.material.clone(), renderOrder: 6 }).material.depthTest = false; });
  const show = () => {
    if (!body) return;
    const [mass, ...pose] = link;
    const turn = body.quaternion.clone().multiply(new THREE.Quaternion(...pose.slice(3)));
    const place = new THREE.Vector3(...pose.slice(0, 3)).applyQuaternion(body.quaternion).add(body.position);
    const { x, y, z } = new THREE.Euler().setFromQuaternion(turn, "ZYX");
    values.mass.textContent = `${figure(mass, 4)} kg`;
    values["x, y, z"].textContent = `${place.toArray().map((each) => fixed(each, 3)).join(", ")} m`;
    values["roll, pitch, yaw"].textContent = `${[x, y, z].map((each) => fixed((each * 180) / Math.PI, 1)).join(", ")}°`;
  };
  const pick = (mesh) => {
    card.hidden = !mesh;
    axes.removeFromParent();
    body = mesh && mesh.parent.parent;
    viewer.set_dirty();
    if (!mesh) return;
    link = info.links[mesh.userData.link];
    heading.textContent = mesh.userData.link;
    axes.position.set(...link.slice(1, 4));
    axes.quaternion.set(...link.slice(4));
    body.add(axes);
    show();
  };
  close.addEventListener("click", () => pick(null));
  let down = null, asked = null;
  pane.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; name.hidden = true; });
  pane.addEventListener("pointerup", (event) => {
    const most = event.pointerType === "touch" ? TAP : STILL;
    if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) <= most) pick(under(event));
    down = null;
  });
  // Once a frame, since a mesh has many triangles.
  pane.addEventListener("pointermove", (event) => {
    if (event.buttons || event.pointerType === "touch") return;
    if (!asked) requestAnimationFrame(() => {
      const mesh = asked && under(asked);
      name.hidden = !mesh;
      pane.style.cursor = mesh ? "pointer" : "";
      if (mesh) {
        name.textContent = mesh.userData.link;
        name.style.transform = `translate(${Math.min(asked.clientX + 14, innerWidth - name.offsetWidth - 4)}px, ${asked.clientY + 14}px)`;
      }
      asked = null;
    });
    asked = event;
  });
  pane.addEventListener("pointerleave", () => { asked = null; name.hidden = true; });
  return show;
}
