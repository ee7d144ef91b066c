"""How the page looks: one sheet for both schemes. Everything is measured in the page's own letters."""

STYLE = """
:root { --ground: #f3f5f7; --card: #ffffff; --text: #1d2730; --faint: #55616d; --line: #d5dbe1;
  --first: #0b6aa8; --second: #b35c00; }
body.body--dark { --ground: #12171b; --card: #1c2329; --text: #eef2f6; --faint: #b4bfca; --line: #3b454f;
  --first: #5db4ea; --second: #ffb054; }
body { background: var(--ground); color: var(--text); overflow-wrap: anywhere; }
.nicegui-content { padding: 0; display: block; }
.page { font-size: 16px; max-width: 110rem; margin: 0 auto; padding: 0.75em; box-sizing: border-box; }
.page.large { font-size: 24px; max-width: none; }
.page h1, .page h2, .page p, .page dl, .page dd, .page ul { margin: 0; padding: 0; letter-spacing: normal; }
.page h1 { font-size: 1.1em; font-weight: 500; line-height: 1.3; color: var(--faint); }
.page h2 { font-size: 1em; font-weight: 600; line-height: 1.3; }
.head { display: flex; flex-wrap: wrap; gap: 0.1em 1em; align-items: baseline; }
.headline { font-size: 1.9em; font-weight: 700; line-height: 1.15; flex-basis: 100%; }
.state, .after { color: var(--faint); }
.after { flex-basis: 100%; white-space: pre-line; }
.after:empty { display: none; }
.controls { display: flex; flex-wrap: wrap; gap: 0.5em 0.75em; align-items: center; margin: 0.6em 0; }
.page .q-btn, .page .q-field, .page .q-toggle { font-size: 0.95em; }
.page.large .q-field--dense .q-field__control, .page.large .q-field--dense .q-field__marginal,
.page.large .q-field--dense .q-field__native { height: 2.9em; min-height: 2.9em; }
.page .q-btn--outline { --q-primary: var(--first); }
.page .q-field__label, .page .q-field__native { color: var(--text); }
.page .q-select { min-width: 6em; }
.note { flex: 1 1 12em; max-width: 30em; }
.time { flex: 1 1 14em; height: 2.2em; accent-color: var(--first); min-width: 8em; }
.clock { font-variant-numeric: tabular-nums; min-width: 8em; }
.page .facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(9.5em, 45%), 1fr)); gap: 0.4em 1em;
  background: var(--card); border: 1px solid var(--line); border-radius: 0.5em; padding: 0.6em 0.8em;
  margin-bottom: 0.75em; margin-top: 0.6em; }
.facts dt { color: var(--faint); font-size: 0.85em; }
.facts dd { white-space: pre-line; font-weight: 600; font-variant-numeric: tabular-nums; line-height: 1.25; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(22em, 100%), 1fr)); gap: 0.75em; }
.panel { background: var(--card); border: 1px solid var(--line); border-radius: 0.5em; padding: 0.6em 0.8em;
  min-width: 0; display: flex; flex-direction: column; gap: 0.3em; }
.chart { width: 100%; height: 17em; }
.camera { width: 100%; height: auto; border-radius: 0.3em; background: #000; aspect-ratio: 16 / 9; }
.says { color: var(--faint); font-size: 0.88em; line-height: 1.35; }
.remarks { list-style: none; max-height: 16em; }
.remarks li { padding: 0.2em 0; border-bottom: 1px solid var(--line); }
.when { color: var(--faint); font-variant-numeric: tabular-nums; display: inline-block; min-width: 4.5em; }
svg.arena { width: 100%; max-height: 21em; display: block; }
.page.large .chart { height: 13em; }
.page.large svg.arena { max-height: 14em; }
.arena .floor { fill: none; stroke: var(--faint); stroke-width: 0.6; }
.arena .shape { fill: var(--first); fill-opacity: 0.16; stroke: var(--first); stroke-width: 0.6; }
.arena .way, .arena .lit { fill: none; stroke-linecap: round; }
.arena .way { stroke: var(--faint); stroke-width: 0.9; opacity: 0.8; }
.arena .lit { stroke: var(--second); stroke-width: 1.7; }
.arena .here { stroke: var(--text); stroke-width: 0.7; fill: none; }
.arena .here.lit { fill: var(--second); }
:focus-visible { outline: 3px solid var(--second); outline-offset: 2px; }
@media (prefers-reduced-motion: reduce) { * { transition: none !important; animation: none !important; } }
"""

SCHEME_SCRIPT = """
const scheme = matchMedia('(prefers-color-scheme: dark)');
scheme.addEventListener('change', () => emitEvent('scheme', scheme.matches));
return scheme.matches;
"""

FAREWELL_SCRIPT = """
window.socket.off('disconnect');
window.socket.io.reconnection(false);
setTimeout(() => window.socket.disconnect(), 300);
"""
