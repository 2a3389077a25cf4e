# The wheel with the newest versions of everything: built, installed without constraints into a fresh
# environment outside the checkout, and used from an empty folder. `bash tests/newest.sh PYTHON`;
# prints every command, the versions and the time.
set -euxo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mkdir "$folder/source" "$folder/empty"
tar -C "$root" --exclude ./.venv --exclude ./.git --exclude ./out --exclude ./build --exclude __pycache__ \
    -c . | tar -C "$folder/source" -x
"$1" -m venv "$folder/venv"
bin=$folder/venv/bin
"$bin/pip" wheel --quiet --no-deps --wheel-dir "$folder" "$folder/source"
wheel=$(ls "$folder"/torchsoft*.whl)
"$bin/pip" install --quiet "$wheel"
"$bin/pip" list

cd "$folder/empty"
"$bin/torchsoft" init mine
"$bin/torchsoft" check mine.toml
"$bin/torchsoft" run mine.toml --out out
cp "$root"/examples/identify/*.{csv,toml} .
"$bin/torchsoft" identify rolling.csv rolling.toml --out fit
"$bin/python" - <<'EOF'
import torch
from torchsoft import RigFile
file = RigFile.ready("paper")
built = file.build()
t = torch.linspace(0, 0.05, 6, dtype=torch.float64)
run = built.run(t, gradient="discrete")
run["y_C"][-1].backward()
slope = built.rig.parameter("materials.rubber.E").grad
assert torch.isfinite(slope) and slope != 0
class Straight(torch.autograd.Function):
    forward = staticmethod(lambda ctx, x: x.clamp(max=0.5))
    backward = staticmethod(lambda ctx, g: g)
try:
    law = lambda E, F_N, R: Straight.apply(E) / R
    file.build({"laws.steel_on_rubber.friction": law}).run(t)
except TypeError as error:
    assert "the torch.autograd.Function" in str(error), error
else:
    raise SystemExit("a law with a backward of its own was not refused")
EOF

"$bin/pip" install --quiet "${wheel}[reduced,datasets,export,learn]"
"$bin/pip" list
"$bin/python" "$root/examples/gallery/reduced_model.py"
"$bin/torchsoft" dataset make "$root/data_gen/configs/smoke.toml" --out set
"$bin/torchsoft" dataset check set
echo "all of it in $SECONDS s"
