// The heading is on the screen before anything else runs: without a graphics card, the scene takes
// seconds.
(() => {
  const LATEST = 2000; // [ms] after which a page that is not painted, such as a frame out of sight, starts
  let started = false;
  const start = () => {
    if (started) return;
    started = true;
    for (const id of ["meshcat", "scripts"]) {
      const script = document.createElement("script");
      script.textContent = document.getElementById(id).textContent;
      document.body.append(script);
    }
    document.getElementById("wait").remove();
  };
  requestAnimationFrame(() => setTimeout(() => {
    if (!PerformanceObserver.supportedEntryTypes.includes("paint")) return start();
    new PerformanceObserver(() => setTimeout(start)).observe({ type: "paint", buffered: true });
    setTimeout(start, LATEST);
  }));
})();
