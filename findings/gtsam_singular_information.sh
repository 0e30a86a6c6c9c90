#!/bin/sh
# GTSAM 4.3.0: a singular information matrix becomes a noise model that is sure in all directions.
#
# noiseModel.Gaussian.Information factorises by Cholesky without pivots. Where rounding makes an
# eigenvalue of 0 slightly negative, the last pivot is taken as it stands: the noise model has an
# information of up to that of other directions, where the matrix has none. No message is given.
# From an eigenvalue of about 1e-14 of the largest on, the noise model is that of the matrix.
#
# Seen, of 1,000 random rotations of diag(0, 2400, 35000): more than half have a least information of
# more than 1 (median about 300); of diag(35000e-12, 2400, 35000): all right to 0.1 %.
# Exit status 0: it still behaves so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gtsam==4.3.0 numpy==2.2.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import gtsam
import numpy as np

def least(smallest):
    """Least information (1000,) of noise models of matrices with this smallest eigenvalue."""
    rng, found = np.random.default_rng(0), []
    for _ in range(1000):
        axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix = (axes * [smallest, 2.4e3, 3.5e4]) @ axes.T
        model = gtsam.noiseModel.Gaussian.Information((matrix + matrix.T) / 2, False)
        found.append(np.linalg.svd(model.R(), compute_uv=False)[-1] ** 2)
    return np.array(found)

singular, regular = least(0.0), least(3.5e-8)
surer = np.mean(singular > 1.0)
print(f"eigenvalue 0: {surer:.0%} are above 1, median {np.median(singular):.0f}")
print(f"eigenvalue 3.5e-8: {regular.min():.4g} to {regular.max():.4g}")
changed = surer < 0.5 or not np.allclose(regular, 3.5e-8, rtol=1e-3)
raise SystemExit("this has changed" if changed else 0)
PYTHON
