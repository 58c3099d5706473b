"""The report's style sheet: one column on a phone, a grid on a desk, light or dark as the reader has it."""

from metrpo.chart_style import COLOURS

_NUMBERED = ";".join(f"--c{i}:{colour}" for i, colour in enumerate(COLOURS))

STYLE = (
    """:root{--bg:#fbfbfa;--card:#fff;--ink:#1d2126;--soft:#626a74;--rule:#e2e4e7;--grid:#eceef0;
--bad:#b3261e;--badbg:#fdeeec;--good:#22713f;--goodbg:#e9f6ed;--note:#7a5b00;
"""
    + _NUMBERED
    + """}
@media(prefers-color-scheme:dark){:root{--bg:#14171a;--card:#1c2024;--ink:#e6e8ea;--soft:#9aa3ad;--rule:#31373d;
--grid:#2a2f35;--bad:#ff8f85;--badbg:#38201e;--good:#7fd39b;--goodbg:#1a3022;--note:#e6c25a;
--c0:#6fa8ea;--c1:#f0a05e;--c2:#74c293;--c3:#ea8782;--c4:#b79be3;--c5:#cbab72}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1200px;margin:0 auto;padding:1.2rem}
h1{font-size:1.7rem;margin:.2rem 0;overflow-wrap:anywhere}
h2{font-size:1.3rem;margin:2rem 0 .6rem;overflow-wrap:anywhere}
h3{font-size:1.02rem;margin:1.2rem 0 .3rem;overflow-wrap:anywhere}
header p,.small,small{color:var(--soft)}
.small,small{font-size:.84rem;font-weight:400}
.path{overflow-wrap:anywhere;margin:.2rem 0 .6rem}
.verdict{display:inline-block;font-weight:600;margin:0 0 .6rem;padding:.25rem .8rem;border-radius:1rem}
.bad{color:var(--bad)}.verdict.bad{background:var(--badbg)}.verdict.good{color:var(--good);background:var(--goodbg)}
.card{background:var(--card);border:1px solid var(--rule);border-radius:.6rem;padding:.7rem 1rem;margin:.6rem 0}
.card h3{margin:0 0 .3rem}.card ul{margin:0;padding:0;list-style:none}
.card li{padding:.15rem 0 .15rem .8rem;margin:.4rem 0;border-left:3px solid var(--rule);overflow-wrap:anywhere}
.card li.warning{border-color:var(--bad)}.card li.note{border-color:var(--note)}
.help{color:var(--soft)}
.scroll{overflow-x:auto;background:var(--card);border:1px solid var(--rule);border-radius:.6rem}
table{border-collapse:collapse;width:100%;font-size:.9rem;font-variant-numeric:tabular-nums}
th,td{padding:.4rem .7rem;text-align:right;border-bottom:1px solid var(--rule);white-space:nowrap}
th:first-child{text-align:left;position:sticky;left:0;background:var(--card)}
tbody tr:last-child>*{border-bottom:0}thead th{color:var(--soft);font-weight:500}
tbody th{font-weight:500}
#runs th:first-child,#groups th:first-child{white-space:normal;min-width:9rem;max-width:26rem;overflow-wrap:anywhere}
#groups thead th{white-space:normal;vertical-align:bottom}
figure{margin:0;background:var(--card);border:1px solid var(--rule);border-radius:.6rem;padding:.6rem;min-width:0}
figcaption{padding:0 .2rem .3rem;line-height:1.3}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(330px,100%),1fr));gap:.8rem;margin:.6rem 0}
details{margin:.8rem 0}summary{cursor:pointer;font-weight:600;padding:.3rem 0;overflow-wrap:anywhere}
.legend{list-style:none;display:flex;flex-wrap:wrap;gap:.1rem 1.1rem;margin:.3rem 0 .5rem;padding:0 .2rem;
font-size:.86rem}
figure .legend,figure .small{margin:.2rem 0 0}figure .small{padding:0 .2rem}
.swatch{display:inline-block;width:.85em;height:.85em;border-radius:.2em;margin-right:.45em;background:currentColor;
vertical-align:-.05em}
.swatch.dashed{opacity:.55}
.video{max-width:520px;margin:.8rem 0}video{width:100%;display:block;border-radius:.3rem}
.narrow{display:none}
svg{display:block;width:100%;height:auto;overflow:visible}
svg text{fill:var(--soft);font:11px system-ui,-apple-system,"Segoe UI",sans-serif}
svg .in{fill:var(--ink)}svg .end{text-anchor:end}svg .mid{text-anchor:middle}
line.grid{stroke:var(--grid)}line.axis,line.zero{stroke:var(--soft)}
polyline{fill:none;stroke:currentColor;stroke-width:1.6;stroke-linejoin:round}
polyline.thick{stroke-width:2.4}polyline.thin{stroke-width:1;opacity:.45}polyline.dashed{stroke-dasharray:5 3}
circle,.fill{fill:currentColor}
.band{fill:currentColor;opacity:.14}
.c0,.real{color:var(--c0)}.c1,.imagined{color:var(--c1)}.c2{color:var(--c2)}.c3{color:var(--c3)}.c4{color:var(--c4)}
.c5{color:var(--c5)}.level{color:var(--soft)}
a{color:var(--c0)}
@media(max-width:640px){main{padding:.8rem}.wide{display:none}.narrow{display:block}h1{font-size:1.4rem}
th,td{padding:.35rem .5rem}
#runs th:first-child,#groups th:first-child{max-width:9rem}}
@media print{details>*{display:block}}
""".strip()
)
