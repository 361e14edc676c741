// The clock of a motion: slider, play, speed. It drives meshcat's own animator, whose seek, play
// and pause stay the way to it from outside.

// The time [s] that the address of the page asks for, or null.
function askedTime() {
  const found = /[#&]t=([-+.\deE]+)/.exec(location.hash);
  return found && Number.isFinite(Number(found[1])) ? Number(found[1]) : null;
}

// Keep the time at which a motion was stopped in the address, so that a link leads there.
function keepTime(time) {
  try {
    history.replaceState(null, "", `#t=${Number(time.toFixed(3))}`);
  } catch (error) {
    console.debug("the address is not writable:", error); // in an embedded page
  }
}

// Whether a page plays by itself.
const playsAtOnce = () => !/[#&]pause\b/.test(location.hash) && askedTime() === null && !window.matchMedia("(prefers-reduced-motion: reduce)").matches;

function makePlayer(viewer, info, quality, onTime) {
  const { t } = info;
  const first = t[0], last = t[t.length - 1];
  const animator = viewer.animator;
  const seekBodies = animator.seek.bind(animator);
  // Until they have been played once, actions take no time.
  Object.getPrototypeOf(animator).play.call(animator);
  Object.getPrototypeOf(animator).pause.call(animator);
  animator.folder.close();

  const bar = document.getElementById("bar");
  const button = document.createElement("button"), slider = document.createElement("input");
  const clock = document.createElement("output"), speeds = document.createElement("select");
  button.className = "play";
  slider.type = "range";
  slider.min = first; slider.max = last; slider.step = "any"; slider.value = first;
  slider.setAttribute("aria-label", "time");
  speeds.setAttribute("aria-label", "speed");
  const choices = [...new Set([0.1, 0.25, 0.5, 1, 2, 5, 10, 20, 50, info.speed])].sort((a, b) => a - b);
  for (const speed of choices) speeds.append(new Option(`${speed}×`, speed));
  speeds.value = info.speed;
  bar.append(button, element("div", { className: "track" }, slider), clock, speeds);

  const state = { time: first, playing: false, speed: info.speed, loop: false };
  const digits = last - first > 200 ? 0 : last - first > 20 ? 1 : 2;
  // The width does not change while the motion plays.
  clock.style.minWidth = `${2 * last.toFixed(digits).length + 3}ch`;
  let then = 0, i = 0;

  const seek = (time) => {
    state.time = Math.min(last, Math.max(first, Number(time) || 0));
    seekBodies(state.time - first);
    animator.display_progress(state.time - first);
    while (i > 0 && t[i] > state.time) i--;
    while (i < t.length - 1 && t[i + 1] <= state.time) i++;
    const next = Math.min(i + 1, t.length - 1);
    onTime(state.time - t[i] <= t[next] - state.time ? i : next, state.time);
    slider.value = state.time;
    clock.textContent = `${state.time.toFixed(digits)} / ${last.toFixed(digits)} s`;
    viewer.set_dirty();
  };
  const mark = () => {
    button.textContent = state.playing ? "❚❚" : "▶";
    button.setAttribute("aria-label", state.playing ? "pause" : "play");
  };
  const play = () => {
    if (state.time >= last) seek(first);
    state.playing = true;
    then = performance.now();
    mark();
  };
  const pause = () => {
    if (state.playing) {
      quality.rest();
      keepTime(state.time);
    }
    state.playing = false;
    mark();
  };
  const setSpeed = (speed) => { state.speed = Number(speed); speeds.value = speed; };

  animator.seek = (time) => seek(first + time);
  animator.play = play;
  animator.pause = pause;
  animator.reset = () => seek(first);
  animator.update = () => {
    if (!state.playing) return;
    const now = performance.now();
    quality.measure(now - then);
    const time = state.time + ((now - then) / 1000) * state.speed;
    then = now;
    seek(time);
    if (state.time < last) return;
    if (state.loop) seek(first);
    else pause();
  };
  slider.addEventListener("input", () => { pause(); seek(slider.value); });
  button.addEventListener("click", () => (state.playing ? pause() : play()));
  speeds.addEventListener("change", () => setSpeed(speeds.value));
  const step = (share) => { pause(); seek(state.time + share * (last - first)); };
  const keys = [
    [" ", "space", "play or pause", () => (state.playing ? pause() : play())],
    ["ArrowRight", "→", "a hundredth on", () => step(0.01)],
    ["ArrowLeft", "←", "a hundredth back", () => step(-0.01)],
    ["Home", "Home", "to the start", () => seek(first)],
    ["End", "End", "to the end", () => seek(last)],
  ];
  mark();
  return { seek, play, pause, setSpeed, state, first, last, keys, slider };
}
