"""Folders of tool masks as other programs write them, four frames of 64x48 px."""

import json

import cv2
import numpy as np
from PIL import Image

SIZE = WIDTH, HEIGHT = 64, 48
FRAMES = 4
DAVIS = [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]
"""Colors of objects 0 to 3."""


def shaft(i):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[: 20 + i, 5:15] = True
    return mask


def jaw(i):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20 + i : 30 + i, 3:20] = True
    return mask


def tissue(i):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, 40:] = True
    return mask


def palette_png(file, labels, palette=DAVIS):
    file.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(labels.astype(np.uint8))
    image.putpalette(palette)
    image.save(file)


def gray_png(file, values):
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), values.astype(np.uint8))


def objects(i):
    """Object 1 is the shaft, 2 the jaw."""
    return shaft(i) + 2 * jaw(i)


def sam2_palette(folder):
    for i in range(FRAMES):
        palette_png(folder / f"{i:05d}.png", objects(i))


def sam2_light_background(folder):
    """Another palette: the background is white, an object is black."""
    for i in range(FRAMES):
        palette_png(folder / f"{i:05d}.png", objects(i), [255, 255, 255, 0, 0, 0, 0, 128, 0])


def sam2_video(folder):
    sam2_palette(folder / "my_video")


def sam2_objects(folder):
    """As `--per_obj_png_file`: values 0 and 1. The jaw is in view from frame 1 on; frame 0 has no file of it."""
    for i in range(FRAMES):
        palette_png(folder / "001" / f"{i:05d}.png", shaft(i))
        if i:
            palette_png(folder / "002" / f"{i:05d}.png", jaw(i))


def sam2_video_objects(folder):
    sam2_objects(folder / "my_video")


def runs_of(pixels):
    """Lengths of runs: outside first."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], pixels.astype(int), [2]])))
    return np.diff(np.concatenate([[0], changes])).tolist()


def packed(runs):
    """COCO's text of run lengths."""
    text = ""
    for i, run in enumerate(runs):
        value = run - runs[i - 2] if i > 2 else run
        more = True
        while more:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            text += chr(48 + bits + 32 * more)
    return text


def coco(mask):
    return {"size": [HEIGHT, WIDTH], "counts": packed(runs_of(mask.T.ravel()))}


def sav(folder):
    folder.mkdir(parents=True, exist_ok=True)
    stored = {
        "video_id": "sav_000001", "video_frame_count": float(FRAMES), "video_height": 48.0, "video_width": 64.0,
        "masklet": [[coco(shaft(i)), coco(jaw(i))] for i in range(FRAMES)], "masklet_id": [0, 1],
        "masklet_type": "manual",
    }  # fmt: skip
    (folder / "sav_000001_manual.json").write_text(json.dumps(stored))


COLORS = {"background": (0, 0, 0), "shaft": (61, 61, 245), "jaw": (250, 50, 83), "tissue": (51, 221, 255)}


def cvat(folder, colors=COLORS):
    lines = ["# label:color_rgb:parts:actions"]
    lines += [f"{name}:{','.join(map(str, color))}::" for name, color in colors.items()]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "labelmap.txt").write_text("\n".join(lines) + "\n")
    (folder / "ImageSets" / "Segmentation").mkdir(parents=True)
    names = [f"frame_{i:06d}" for i in range(FRAMES)]
    (folder / "ImageSets" / "Segmentation" / "default.txt").write_text("\n".join(names) + "\n")
    for i, name in enumerate(names):
        image = np.full((HEIGHT, WIDTH, 3), colors["background"], np.uint8)
        for label, part in (("tissue", tissue), ("shaft", shaft), ("jaw", jaw)):
            image[part(i)] = colors[label]
        for part in ("SegmentationClass", "SegmentationObject"):
            gray_png(folder / part / f"{name}.png", image[..., ::-1])
    return folder


def cvat_green_background(folder):
    cvat(folder, COLORS | {"background": (0, 128, 0)})


def cvat_indices(folder):
    cvat(folder)
    for i in range(FRAMES):
        indices = np.where(jaw(i), 2, np.where(shaft(i), 1, np.where(tissue(i), 3, 0)))
        gray_png(folder / "SegmentationClass" / f"frame_{i:06d}.png", indices)


def cvat_xml(folder):
    """The shaft is a mask, the jaw a polygon, tissue a polygon below both."""
    folder.mkdir(parents=True, exist_ok=True)
    images = []
    for i in range(FRAMES):
        part = shaft(i)[: 20 + i, 5:15]
        images.append(
            f"""  <image id="{i}" name="clip/frame_{i:06d}.png" width="{WIDTH}" height="{HEIGHT}">
    <polygon label="tissue" source="manual" occluded="0" points="40.00,0.00;64.00,0.00;64.00,48.00" z_order="0">
    </polygon>
    <mask label="shaft" source="manual" occluded="0" rle="{", ".join(map(str, runs_of(part.ravel())))}" left="5"
     top="0" width="10" height="{20 + i}" z_order="1">
    </mask>
    <polygon label="jaw" source="manual" occluded="0" z_order="1"
     points="3.00,{20 + i}.00;20.00,{20 + i}.00;20.00,{30 + i}.00;3.00,{30 + i}.00">
    </polygon>
    <box label="jaw" source="manual" occluded="0" xtl="1" ytl="1" xbr="5" ybr="5" z_order="0"></box>
  </image>"""
        )
    labels = "".join(f"<label><name>{name}</name></label>" for name in ("shaft", "jaw", "tissue"))
    (folder / "annotations.xml").write_text(
        "<?xml version='1.0' encoding='utf-8'?>\n<annotations>\n  <version>1.1</version>\n"
        f"  <meta><task><labels>{labels}</labels></task></meta>\n" + "\n".join(images) + "\n</annotations>\n"
    )


def label_studio(folder, suffix=".png", first=7):
    """Task 8 has two regions of the shaft."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(FRAMES):
        upper = shaft(i).copy()
        upper[10:] = False
        parts = {"Shaft-0": shaft(i), "Needle-driver-0": jaw(i), "tissue-0": tissue(i)}
        if i == 1:
            parts |= {"Shaft-0": upper, "Shaft-1": shaft(i) & ~upper}
        for name, mask in parts.items():
            file = folder / f"task-{first + i}-annotation-{50 + i}-by-1-tag-{name}"
            if suffix == ".npy":
                np.save(file, np.where(mask, 255, 0).astype(np.uint8))
            else:
                gray_png(file.with_name(file.name + suffix), 255 * mask)


def label_studio_numpy(folder):
    label_studio(folder, ".npy")


def label_studio_twins(folder):
    label_studio(folder, ".png")
    label_studio(folder, ".npy")


def nerfstudio(folder):
    frames = []
    for i in range(FRAMES):
        keep = 255 * ~(shaft(i) | jaw(i))
        gray_png(folder / "masks" / f"frame_{i + 1:05d}.png", keep)
        gray_png(folder / "masks_2" / f"frame_{i + 1:05d}.png", keep[::2, ::2])
        frames.append({"file_path": f"images/frame_{i + 1:05d}.png", "mask_path": f"masks/frame_{i + 1:05d}.png"})
    (folder / "transforms.json").write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "frames": frames[::-1]}))


def plain(folder):
    for i in range(FRAMES):
        gray_png(folder / f"m{i}.png", 255 * (shaft(i) | jaw(i)))
