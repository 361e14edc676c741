// The scene of the front page is shown when it is drawn; until then, its picture is.
window.addEventListener("message", ({ data }) => {
  if (data === "fflin-hero") document.querySelector(".fflin-hero")?.classList.add("drawn");
});
