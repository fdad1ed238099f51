"""Reader of `scene.safetensors` that needs nothing but NumPy, as docs/format.md defines the file. Copy it freely."""

import json

import numpy as np


def read(path):
    """Arrays by name, and the description."""
    with open(path, "rb") as file:
        raw = file.read()
    start = 8 + int.from_bytes(raw[:8], "little")
    header = json.loads(raw[8:start])
    about = json.loads(header.pop("__metadata__")["endoprior"])
    arrays = {}
    for name, entry in header.items():
        begin, end = (start + offset for offset in entry["data_offsets"])
        kind = {"F32": "<f4", "F64": "<f8"}[entry["dtype"]]
        arrays[name] = np.frombuffer(raw[begin:end], kind).reshape(entry["shape"])
    return arrays, about


def basis_offsets(arrays, about, t):
    def splines(count):
        x = np.abs(t * (count - 3) - np.arange(count) + 1)
        return np.where(x < 1, 2 / 3 - x**2 + x**3 / 2, np.maximum(2 - x, 0) ** 3 / 6)

    motion, changes, shifts = (arrays[f"gaussians.{name}"] for name in ("motion", "changes", "frame_motion"))
    near = np.maximum(0, 1 - np.abs(t * shifts.shape[1] - np.arange(shifts.shape[1])))
    moved = np.einsum("b,nbc->nc", splines(motion.shape[1]), motion) + np.einsum("f,nfc->nc", near, shifts)
    total, cfg = np.einsum("b,nbc->nc", splines(changes.shape[1]), changes), about["config"]["deformation"]
    shape = cfg["deform_shape"]
    widths = {"quats": 4 * shape, "log_scales": 3 * shape, "opacity_logits": 1 * cfg["deform_opacity"], "sh_dc": 3}
    ends = np.cumsum(list(widths.values()))
    parts = {
        name: total[:, end - width : end] for (name, width), end in zip(widths.items(), ends, strict=True) if width
    }
    return {"means": moved} | parts


def at(arrays, about, t, offsets=basis_offsets):
    """Centers (N, 3) mm, quaternions (N, 4) wxyz, scales (N, 3) mm, opacities (N,), coefficients (N, K, 3) at t."""
    t = min(max(t, about.get("trained_from", 0)), about.get("trained_until", 1))
    found, d = {k[10:]: v for k, v in arrays.items() if k.startswith("gaussians.")}, offsets(arrays, about, t)
    means, quats = found["means"] + d["means"], found["quats"] + d.get("quats", 0)
    change = about["config"]["deformation"].get("max_scale_change", 0)
    limit = np.log(change) if change > 1 else np.inf
    scales = np.exp(found["log_scales"] + np.clip(d.get("log_scales", 0), -limit, limit))
    logits = found["opacity_logits"] + d.get("opacity_logits", np.zeros((1, 1)))[:, 0]
    num_rest = (about["config"]["schedule"]["sh_degree"] + 1) ** 2 - 1
    dc = found["sh_dc"] + np.reshape(d.get("sh_dc", np.zeros((1, 3))), (-1, 1, 3))
    return means, quats, scales, 1 / (1 + np.exp(-logits)), np.concatenate([dc, found["sh_rest"][:, :num_rest]], 1)


def hexplane_offsets(arrays, about, t):
    cfg = about["config"]["deformation"]["hexplane"]
    field = {k[6:]: v for k, v in arrays.items() if k.startswith("field.")}
    first, second = field["hexplane.box"]
    u = (arrays["gaussians.means"] - first) / (second - first)
    where = {"x": u[:, 0], "y": u[:, 1], "z": u[:, 2]}
    where["t"] = np.full(len(u), t if cfg.get("time_map") == "full" else (t + 1) / 2)
    features = []
    for scale in range(len(cfg["multires"])):
        product = 1
        for a, b in ("xy", "xz", "yz", "xt", "yt", "zt"):
            plane = field[f"hexplane.{scale}.{a}{b}"]
            rows, columns, _ = plane.shape
            x, y = np.clip(where[a], 0, 1) * (columns - 1), np.clip(where[b], 0, 1) * (rows - 1)
            i, j = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
            f, g = (x - i)[:, None], (y - j)[:, None]
            near = plane[j, i] * (1 - f) + plane[j, i + 1] * f
            far = plane[j + 1, i] * (1 - f) + plane[j + 1, i + 1] * f
            product = product * (near * (1 - g) + far * g)
        features.append(product)

    def layer(name, x):
        return x @ field[f"heads.{name}.weight"].T + field[f"heads.{name}.bias"]

    h = np.maximum(layer("trunk", np.concatenate(features, 1)), 0)
    heads = {k.split(".")[1] for k in field if k.endswith(".output.weight")}
    return {name: layer(f"{name}.output", np.maximum(layer(f"{name}.hidden", h), 0)) for name in heads}
