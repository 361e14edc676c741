// The heading is painted before anything else runs: the scene takes seconds without a graphics card.
requestAnimationFrame(() => setTimeout(() => {
  for (const id of ["meshcat", "scripts"]) {
    const script = document.createElement("script");
    script.textContent = document.getElementById(id).textContent;
    document.body.append(script);
  }
  document.getElementById("wait").remove();
}));
