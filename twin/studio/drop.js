// Files and folders that are dropped on the page go to the upload button that is visible for them. A folder, or several
// files, become an archive.
if (!window.takesDrops) {
  window.takesDrops = true;
  const table = Array.from({ length: 256 }, (_, n) => {
    for (let k = 0; k < 8; k++) n = n & 1 ? (n >>> 1) ^ 0xedb88320 : n >>> 1;
    return n;
  });
  const crc = (bytes) => ~bytes.reduce((sum, byte) => table[(sum ^ byte) & 255] ^ (sum >>> 8), -1) >>> 0;
  const walk = async (entry, folder) => {
    if (entry.isFile) return [[folder + entry.name, await new Promise((done, failed) => entry.file(done, failed))]];
    const reader = entry.createReader(), inside = [];
    for (let some = [0]; some.length; inside.push(...some)) some = await new Promise((done, failed) => reader.readEntries(done, failed));
    return (await Promise.all(inside.map((each) => walk(each, folder + entry.name + "/")))).flat();
  };
  const numbers = (...fields) => {
    const view = new DataView(new ArrayBuffer(fields.reduce((sum, [, size]) => sum + size, 0)));
    fields.reduce((at, [value, size]) => (size === 2 ? view.setUint16(at, value, true) : view.setUint32(at, value, true), at + size), 0);
    return view;
  };
  const zip = async (files, name) => {
    const parts = [], index = [];
    let at = 0, length = 0;
    for (const [path, file] of files) {
      const bytes = new Uint8Array(await file.arrayBuffer()), text = new TextEncoder().encode(path), size = bytes.length;
      const facts = [[20, 2], [0x800, 2], [0, 2], [0, 4], [crc(bytes), 4], [size, 4], [size, 4], [text.length, 2], [0, 2]];
      parts.push(numbers([0x04034b50, 4], ...facts), text, bytes);
      index.push(numbers([0x02014b50, 4], [20, 2], ...facts, [0, 2], [0, 4], [0, 4], [at, 4]), text);
      at += 30 + text.length + size;
      length += 46 + text.length;
    }
    const end = numbers([0x06054b50, 4], [0, 4], [files.length, 2], [files.length, 2], [length, 4], [at, 4], [0, 2]);
    return new File([...parts, ...index, end], name + ".zip");
  };
  window.addEventListener("dragover", (event) => event.preventDefault());
  window.addEventListener("drop", async (event) => {
    event.preventDefault();
    const [first] = event.dataTransfer.files, entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
    const several = entries.length > 1 || entries[0]?.isDirectory, name = entries.length > 1 ? "dropped" : entries[0]?.name;
    const file = several ? await zip((await Promise.all(entries.map((entry) => walk(entry, "")))).flat(), name) : first;
    const kind = /\.(stl|obj|ply)$/i.test(file?.name ?? "") ? ".stl" : ".zip";
    const input = document.querySelector(`input[type=file][accept*="${kind}"]`);
    if (!file || !input) return;
    const carried = new DataTransfer();
    carried.items.add(file);
    input.files = carried.files;
    input.dispatchEvent(new Event("change", { bubbles: true }));
  });
}
