// Bundles the page into a folder: `node build.mjs dist`. Names carry a hash of their content, so that they may be
// cached for ever; the page itself names them. `node build.mjs --tests OUT` bundles the unit tests instead.
import { build } from 'esbuild';
import { createHash } from 'node:crypto';
import { mkdir, readFile, readdir, rm, writeFile } from 'node:fs/promises';
import { join, resolve } from 'node:path';
import { constants, gzipSync } from 'node:zlib';

const COMMON = {
  bundle: true, format: 'esm', target: 'es2022', legalComments: 'none', logLevel: 'warning', charset: 'utf8',
  loader: { '.wasm': 'file', '.svg': 'file' }, assetNames: '[name]-[hash]', entryNames: '[name]-[hash]',
};

// three.js brings the shaders of all its materials, a quarter of what it is. Ours are raw, and include none of them.
const WITHOUT_SHADERS = {
  name: 'without shaders',
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^three$/ }, () => ({ path: resolve('node_modules/three/src/Three.js'), sideEffects: false }));
    onLoad({ filter: /three\/src\/renderers\/shaders\/ShaderChunk\.js$/ }, () => ({ contents: 'export const ShaderChunk = {};' }));
    onLoad({ filter: /three\/src\/renderers\/shaders\/ShaderLib\.js$/ }, () => ({ contents: 'export const ShaderLib = {};' }));
  },
};

const named = (outputs, entry) => {
  const [path] = Object.entries(outputs).find(([, output]) => output.entryPoint === entry);
  return path.split('/').at(-1);
};

async function page(out) {
  await rm(out, { recursive: true, force: true });
  await mkdir(out, { recursive: true });
  const common = { ...COMMON, minify: true, platform: 'browser', external: ['fs', 'path'], outdir: out, metafile: true, plugins: [WITHOUT_SHADERS] };
  const later = await build({ ...common, entryPoints: ['src/admin/admin.ts'] });
  const admin = { ADMIN_FILE: JSON.stringify(named(later.metafile.outputs, 'src/admin/admin.ts')) };
  const { outputs } = (await build({ ...common, define: admin, entryPoints: ['src/worker.ts', 'src/main.ts', 'src/style.css'] })).metafile;
  const [worker, script, style] = ['worker.ts', 'main.ts', 'style.css'].map((entry) => named(outputs, `src/${entry}`));
  const define = { WORKER_FILE: JSON.stringify(worker), MAIN_FILE: JSON.stringify(script) };
  const [{ text: boot }] = (await build({ ...common, define, format: 'iife', write: false, entryPoints: ['src/boot.ts'] })).outputFiles;
  const wasm = Object.keys(outputs).find((path) => path.endsWith('.wasm')).split('/').at(-1);
  const [scriptHash, styleHash] = await Promise.all([script, style, worker].map((name) => hashInline(join(out, name))));
  const notices = await licenses();
  const notice = `licenses-${createHash('sha256').update(notices).digest('hex').slice(0, 8)}.txt`;
  const names = { boot, script, style, worker, wasm, notice, scriptHash, styleHash };
  const html = (await readFile('index.html', 'utf8')).replace(/%(\w+)%/g, (_, name) => names[name].trim());
  await writeFile(join(out, 'index.html'), html);
  for (const file of await readdir(out)) await squeeze(join(out, file));
  await writeFile(join(out, notice), notices);
}

// Offline copies have scripts and style within the page, and a policy that lets these run alone: the hash it names them by.
async function hashInline(path) {
  const text = await readFile(path);
  if (/<!--/.test(text) || new RegExp(path.endsWith('.css') ? '</style' : '</script', 'i').test(text)) throw new Error(`${path} cannot stand within a page`);
  return `sha256-${createHash('sha256').update(text).digest('base64')}`;
}

// What is bundled is others' work: their licences travel with it.
async function licenses() {
  const { dependencies } = JSON.parse(await readFile('package.json', 'utf8'));
  const parts = Object.entries(dependencies).map(async ([name, version]) => {
    const folder = join('node_modules', name);
    const file = (await readdir(folder)).find((entry) => /^licen[cs]e/i.test(entry));
    return `${name} ${version}\n\n${await readFile(join(folder, file), 'utf8')}`;
  });
  return (await Promise.all(parts)).join(`\n${'-'.repeat(80)}\n\n`);
}

async function squeeze(path) {
  const packed = gzipSync(await readFile(path), { level: constants.Z_BEST_COMPRESSION });
  await writeFile(`${path}.gz`, packed);
}

async function tests(out) {
  const entryPoints = (await readdir('tests')).filter((name) => name.endsWith('.test.ts')).map((name) => `tests/${name}`);
  const banner = { js: "import { createRequire } from 'node:module'; const require = createRequire(import.meta.url); const __dirname = import.meta.dirname, __filename = import.meta.filename;" };
  await build({ ...COMMON, entryPoints, outdir: out, entryNames: '[name]', outExtension: { '.js': '.mjs' }, platform: 'node', banner });
}

const [first, second] = process.argv.slice(2);
await (first === '--tests' ? tests(second) : page(first ?? 'dist'));
