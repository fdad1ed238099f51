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
    cfg, motion = about["config"]["deformation"], arrays["gaussians.motion"]
    d = (t - np.linspace(0, 1, motion.shape[1])) / (cfg["basis"].get("relative_width", 1.5) / motion.shape[1])
    e = np.exp(-4.5)
    total = np.einsum("b,nbc->nc", np.maximum(0, (np.exp(-(d**2) / 2) - e) / (1 - e)), motion)
    turns, grows = (cfg.get(name, cfg.get("deform_shape")) for name in ("deform_quats", "deform_scales"))
    widths = {"means": 3, "quats": 4 * turns, "log_scales": 3 * grows}
    widths |= {"opacity_logits": 1 * cfg["deform_opacity"], "sh_dc": 3 * cfg["basis"].get("deform_color", True)}
    ends = np.cumsum(list(widths.values()))
    return {name: total[:, end - width : end] for (name, width), end in zip(widths.items(), ends, strict=True) if width}


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
