"""Run by Blender, or by a Python that has its package bpy: import a file and store what it shows in some frames.

blender --background --factory-startup --python-exit-code 1 --python read_in_blender.py -- FILE OUT PICTURE FRAMES...
python read_in_blender.py -- FILE OUT PICTURE FRAMES...

FILE is a .glb, whose seconds Blender turns into 24 frames each, or a USD stage, whose time codes are frames. PICTURE is
a .png of the last frame, or - for none.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

if not hasattr(np, "bool"):
    np.bool = bool  # the importer of Debian's Blender 3.4 needs it, Debian's numpy 1.24 no longer has it
file, out, picture, *frames = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
(bpy.ops.import_scene.gltf if Path(file).suffix == ".glb" else bpy.ops.wm.usd_import)(filepath=file)
(tissue,) = (found for found in bpy.data.objects if found.type == "MESH")
cameras = [found for found in bpy.data.objects if found.type == "CAMERA"]
scene, positions, poses = bpy.context.scene, [], []
for frame in map(float, frames):
    scene.frame_set(int(frame), subframe=frame - int(frame))
    graph = bpy.context.evaluated_depsgraph_get()
    moved = tissue.evaluated_get(graph)
    positions.append([moved.matrix_world @ vertex.co for vertex in moved.data.vertices])
    poses.append([np.array(camera.evaluated_get(graph).matrix_world) for camera in cameras])
(attribute,) = tissue.data.color_attributes
corners = [loop.vertex_index for loop in tissue.data.loops]
rows = corners if attribute.domain == "POINT" else range(len(corners))
materials = [{node.type for node in material.node_tree.nodes} for material in tissue.data.materials]
np.savez(
    out,
    positions=np.array(positions),  # (T, V, 3) m, Blender's axes
    triangles=np.array([polygon.vertices for polygon in tissue.data.polygons]),
    colors=np.array([tuple(attribute.data[row].color) for row in rows]),  # (3 F, 4) linear, of the corners
    corners=np.array(corners),  # (3 F,) vertex of each corner
    shows_colors=np.array([bool({"VERTEX_COLOR", "ATTRIBUTE"} & found) for found in materials]),
    poses=np.array(poses),  # (T, C, 4, 4) camera to world
    frames=np.array([scene.frame_start, scene.frame_end]),
)
if picture != "-":
    scene.camera = cameras[0]
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 4, "CPU"
    scene.render.resolution_x, scene.render.resolution_y = 640, 512
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = picture
    bpy.ops.render.render(write_still=True)
