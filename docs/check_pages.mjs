// Does every page of the built site pass axe's checks (WCAG 2.1, level AA), at two widths, in both colour modes, without an
// error in its console, a request that leaves the machine, or a page that is wider than the screen?
//
//     npm install --no-save axe-core playwright-core        (in any folder; NODE_PATH says which)
//     NODE_PATH=.../node_modules node docs/check_pages.mjs [--shots FOLDER] [--quick] [PART OF A PAGE'S NAME ...]
//
// CHROMIUM names the browser, /usr/bin/chromium by default. The exit status is 1 where anything is found. `--quick` leaves the
// dark mode out, `--shots` keeps a picture of each page. Node reads no NODE_PATH for modules, so both are required here.

import { createRequire } from "node:module";
import { createServer } from "node:http";
import fs from "node:fs";
import path from "node:path";

const require = createRequire(path.join(process.env.NODE_PATH ?? "node_modules", "x.js"));
const { chromium } = require("playwright-core");
const axe = fs.readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");

const root = path.join(import.meta.dirname ?? path.dirname(new URL(import.meta.url).pathname), "_build", "html");
const args = process.argv.slice(2);
const shots = args.includes("--shots") ? args[args.indexOf("--shots") + 1] : null;
const quick = args.includes("--quick");
const wanted = args.filter((word) => !word.startsWith("--") && word !== shots);
const types = { html: "text/html", css: "text/css", js: "text/javascript", png: "image/png", svg: "image/svg+xml", woff2: "font/woff2" };
const server = createServer((request, response) => {
    const file = path.join(root, decodeURIComponent(new URL(request.url, "http://x").pathname));
    if (!file.startsWith(root) || !fs.existsSync(file) || fs.statSync(file).isDirectory()) return response.writeHead(404).end();
    response.writeHead(200, { "content-type": types[file.split(".").pop()] ?? "application/octet-stream" });
    fs.createReadStream(file).pipe(response);
}).listen(0);
const origin = `http://127.0.0.1:${server.address().port}`;
const pages = fs.readdirSync(root, { recursive: true })
    .filter((name) => name.endsWith(".html") && !name.startsWith("_static") && (!wanted.length || wanted.some((part) => name.includes(part))))
    .sort();

const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
        "--disable-component-update", "--disable-sync"],
});
let checks = 0;
const found = new Map();
const tell = (what, where) => found.set(what, [...(found.get(what) ?? []), where]);
for (const width of [1280, 390]) {
    for (const colorScheme of quick ? ["light"] : ["light", "dark"]) {
        const context = await browser.newContext({ viewport: { width, height: 900 }, colorScheme, bypassCSP: true });
        for (const name of pages) {
            const where = `${name} (${width}, ${colorScheme})`;
            const page = await context.newPage();
            page.on("pageerror", (error) => tell(`script: ${error.message}`, where));
            page.on("console", (line) => line.type() === "error" && tell(`console: ${line.text()}`, where));
            page.on("request", (request) => {
                if (!request.url().startsWith(origin) && !/^(data|blob):/.test(request.url())) tell(`request: ${request.url()}`, where);
            });
            await page.goto(`${origin}/${name}`, { waitUntil: "load" });
            if (shots) {
                fs.mkdirSync(shots, { recursive: true });
                await page.screenshot({ path: path.join(shots, `${name.replaceAll("/", "+")}.${width}.${colorScheme}.png`) });
            }
            const wide = await page.evaluate(() => document.documentElement.scrollWidth - window.innerWidth);
            if (wide > 1) tell(`page: wider than the screen by ${wide} px`, where);
            await page.evaluate(axe);
            const result = await page.evaluate(() =>
                globalThis.axe.run(document, { runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"], resultTypes: ["violations"] }));
            for (const violation of result.violations)
                for (const node of violation.nodes.slice(0, 3))
                    tell(`${violation.id}: ${violation.help}`, `${where}: ${node.target} ${node.html.slice(0, 120)}`);
            checks += 1;
            await page.close();
        }
        await context.close();
    }
}
await browser.close();
server.close();
for (const [what, places] of found) {
    console.log(`${what}: ${places.length}`);
    for (const place of places.slice(0, 5)) console.log(`    ${place}`);
}
console.log(`${pages.length} pages, ${checks} checks, ${found.size} kinds of finding`);
process.exit(found.size ? 1 : 0);
