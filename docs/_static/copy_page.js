// A button at the head of a page whose blocks of Python are one program.
document.addEventListener("DOMContentLoaded", () => {
  const blocks = [...document.querySelectorAll("article .highlight-python pre")];
  const title = document.querySelector("article h1");
  if (blocks.length < 2 || !title || !navigator.clipboard) return;
  const button = document.createElement("button");
  const label = "Copy all code of this page";
  button.className = "copy-page";
  button.textContent = label;
  button.addEventListener("click", async () => {
    const code = blocks.map((block) => block.textContent.trimEnd()).join("\n\n");
    await navigator.clipboard.writeText(code + "\n");
    button.textContent = "Copied";
    setTimeout(() => (button.textContent = label), 2000);
  });
  title.after(button);
});
