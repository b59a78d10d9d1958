// The buttons of a report's replays: each opens its episode in a frame below the table, and closes it again.
// The page that draws an episode is here once, and so is each recording, as base64 of gzip.

const unpacked = async (id) => {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
};
const escaped = (text) => new Option(text).innerHTML;

for (const button of document.querySelectorAll("button.replay")) {
  button.setAttribute("aria-pressed", false);
  button.onclick = async () => {
    const table = button.closest(".table") ?? button.parentElement;
    const open = button.getAttribute("aria-pressed") === "true";
    if (table.nextElementSibling?.matches("iframe.replay")) table.nextElementSibling.remove();
    for (const other of table.querySelectorAll("button.replay")) other.setAttribute("aria-pressed", other === button && !open);
    if (open) return;
    const frame = Object.assign(document.createElement("iframe"), { className: "replay", title: `3D replay: ${button.title}` });
    table.after(frame);
    try {
      const [page, recording] = await Promise.all([unpacked("replay-page"), unpacked(button.value)]);
      frame.srcdoc = page
        .replaceAll("{{title}}", () => escaped(button.title))
        .replace("{{recording}}", () => recording.replaceAll("<", "\\u003c"));
    } catch (problem) {
      frame.srcdoc = `<p>This browser cannot unpack the replay (${escaped(problem.message)}).</p>`;
    }
  };
}
