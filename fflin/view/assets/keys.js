// Keys of a page, and the help that names them.

// An element with properties and children.
function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

// Of each key the name, what it does and the action. Returns what shows or hides the help.
function makeKeys(keys) {
  const help = element("div", { id: "help", hidden: true });
  const toggle = () => { help.hidden = !help.hidden; };
  const all = [
    ...keys,
    ["g", "G", "tree of the scene", () => { if (document.body.classList.toggle("tree")) viewer.gui.open(); }],
    ["?", "?", "this help", toggle],
    ["Escape", "Esc", "close what is open", () => {
      help.hidden = true;
      document.querySelectorAll("#large:not([hidden]) .close, #link:not([hidden]) .close").forEach((each) => each.click());
    }],
  ];
  const list = element("dl");
  const row = (kind, name, what) => list.append(element("dt", { className: kind }, name), element("dd", { className: kind }, what));
  for (const [, name, what] of all) row("keyboard", name, what);
  row("keyboard", "mouse", "drag: turn; right button: shift; wheel: zoom; click a link: its mass and pose");
  row("touch", "one finger", "turn");
  row("touch", "two fingers", "shift and zoom");
  row("touch", "tap a link", "its mass and pose");
  row("touch", "tap a chart", "enlarge it");
  help.append(list);
  help.addEventListener("click", toggle);
  document.getElementById("overlay").append(help);
  window.addEventListener("keydown", (event) => {
    const found = all.find(([key]) => key === event.key);
    if (!found || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select, textarea")) return;
    if (event.target.matches("button") && [" ", "Enter"].includes(event.key)) return;
    event.preventDefault();
    found[3]();
  });
  // What was clicked with a pointer leaves the keys to the page.
  window.addEventListener("click", (event) => { if (event.detail && event.target.matches("button, input[type=range]")) event.target.blur(); });
  return toggle;
}

const viewKeys = (camera, pick) => camera.views.map((name, k) => [`${k}`, `${k}`, name === "overview" ? name : `${name} view`, () => pick(name)]);

// The choice of a view and the help at the end of the bar. Returns the keys of the views.
function makeViews(bar, camera) {
  const choice = element("select", { title: "view of the camera" }, ...camera.views.map((name) => new Option(name, name)), new Option("free", ""));
  choice.setAttribute("aria-label", "view");
  choice.options[choice.length - 1].hidden = true;
  const pick = (name) => { choice.value = name; camera.setView(name); };
  choice.addEventListener("change", () => pick(choice.value));
  camera.whenTaken(() => { choice.value = ""; });
  bar.append(choice);
  return viewKeys(camera, pick);
}

function makeHelpButton(bar, toggle) {
  const button = element("button", { className: "help", title: "keys" }, "?");
  button.addEventListener("click", toggle);
  bar.append(button);
}
