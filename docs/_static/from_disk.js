// A page from the disk may not fetch other pages. There the search takes its excerpts from
// `_static/excerpts.js`, which contains the text of all pages.
if (location.protocol === "file:" && document.getElementById("search-results")) {
  const script = document.createElement("script");
  const loaded = new Promise((done) => { script.onload = done; });
  script.src = new URL("_static/excerpts.js", location.href).href;
  document.head.append(script);
  const fetched = window.fetch;
  let make = null;
  window.fetch = async (address, ...rest) => {
    await loaded;
    if (make === null) {
      make = Search.makeSearchSummary;
      // Without the place in the page, which the text does not contain.
      Search.makeSearchSummary = (text, words) => make(text, words);
    }
    const root = location.href.replace(/search\.html.*/, "");
    const page = decodeURI(new URL(address, root).href.replace(root, "").replace(/\.html.*/, ""));
    const text = window.FFLIN_EXCERPTS[page];
    if (text === undefined) return fetched(address, ...rest);
    const main = document.createElement("div");
    main.setAttribute("role", "main");
    main.textContent = text;
    return { text: async () => main.outerHTML };
  };
}
