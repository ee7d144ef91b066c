// Runs Python on MicroPython: node runner.mjs MICROPYTHON.mjs JOB.json
// The job: {"files": {"path there": "path here"}, "steps": ["source", ...]}. Each step is a call of its own, at top
// level, so that nothing of the step before is still on the stack. What is printed goes to standard output.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [build, job] = process.argv.slice(2);
const { loadMicroPython } = await import(pathToFileURL(build));
const { files, steps } = JSON.parse(readFileSync(job, "utf8"));
const micropython = await loadMicroPython({ stdout: (line) => process.stdout.write(line + "\n") });
for (const [there, here] of Object.entries(files)) {
  const folder = there.split("/").slice(0, -1).join("/");
  if (folder) micropython.FS.mkdirTree(folder);
  micropython.FS.writeFile(there, readFileSync(here));
}
try {
  for (const step of steps) micropython.runPython(step);
} catch (error) {
  process.stderr.write(String(error.message) + "\n");
  process.exit(1);
}
