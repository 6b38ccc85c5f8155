"""Style sheet of the page: light or dark as the reader's system is, wide or narrow."""

STYLE = """
:root { color-scheme: light dark; --ink: #1d1f21; --soft: #5d6670; --line: #d9dde1; --paper: #ffffff;
  --card: #f6f7f8; --good: #14713a; --bad: #b3261e; --good-tint: #e5f4ea; --bad-tint: #fce9e7; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaed; --soft: #a3abb3; --line: #3a3f45;
  --paper: #17191c; --card: #202327; --good: #6fd394; --bad: #ff8d84; --good-tint: #16301f;
  --bad-tint: #3a1c1a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.2rem; max-width: 62rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .8rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1.08rem; margin: 1.8rem 0 .4rem; border-bottom: 2px solid var(--line); }
h4 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p { margin: .4rem 0; overflow-wrap: anywhere; }
.soft { color: var(--soft); }
.verdict { border-left: .5rem solid; border-radius: .4rem; padding: .8rem 1.1rem; }
.verdict.pass { color: var(--good); background: var(--good-tint); }
.verdict.fail { color: var(--bad); background: var(--bad-tint); }
.verdict strong { font-size: 2.3rem; line-height: 1.2; letter-spacing: .02em; margin-right: .6rem; }
.verdict span { font-size: 1.15rem; }
.verdict p { color: var(--ink); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .32rem .7rem .32rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; color: var(--soft); }
th[scope="row"] { width: 11rem; }
td.number, td.verdict-word { width: 8.5rem; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
td small { display: block; color: var(--soft); line-height: 1.35; }
@media (max-width: 40rem) { th[scope="row"] { width: 7rem; } td.number, td.verdict-word { width: auto; } }
td.value { overflow-wrap: anywhere; }
.word { font-weight: 700; white-space: nowrap; }
.word.pass { color: var(--good); }
.word.fail { color: var(--bad); }
.word.none { color: var(--soft); font-weight: 400; }
figure { margin: 0 0 1.2rem; }
figcaption { color: var(--soft); font-size: .9rem; }
img, video { display: block; max-width: 100%; height: auto; border-radius: .4rem; background: #fff; }
details { margin-top: 1.2rem; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; background: var(--card); padding: .8rem; border-radius: .4rem; font-size: .8rem; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(26rem, 100%), 1fr)); gap: .4rem 1rem; }
.charts figure { margin: 0; }
.charts figcaption span { margin-left: .6rem; background: #fff; padding: 0 .25rem; border-radius: .2rem; }
.charts output { display: block; font-size: .78rem; color: var(--soft); min-height: 1.2rem;
  font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
svg[data-chart] { display: block; width: 100%; height: auto; background: #fff; border-radius: .4rem; cursor: crosshair;
  touch-action: pan-y; }
svg[data-chart] text { font: 11px system-ui, sans-serif; fill: #444; }
svg polyline { fill: none; stroke-linejoin: round; stroke-linecap: round; }
svg .open { stroke-width: 4; } svg .gains { stroke-width: 2.2; }
svg .plan { stroke-width: 1.3; stroke-dasharray: 4 2; } svg .bound { stroke-width: 1; stroke-dasharray: 1 3; }
svg .grid { stroke: #ddd; stroke-width: .6; }
svg .cursor { stroke: #d0021b; stroke-width: 1; visibility: hidden; }
.keys { font-size: .85rem; color: var(--soft); }
.key { display: inline-block; width: 1.6rem; vertical-align: middle; border-top: 4px solid #ccc; }
.key.gains { border-top: 3px solid #8a8a8a; } .key.plan { border-top: 2px dashed currentColor; }
.key.bound { border-top: 2px dotted #555; }
.bar { display: flex; gap: .8rem; align-items: center; position: sticky; top: 0; background: var(--paper); z-index: 1; }
.bar input { flex: 1; } #now { min-width: 7rem; font-variant-numeric: tabular-nums; }
"""
