"""Run by Blender: import a .glb file and store what its mesh is at some times.

blender --background --factory-startup --python-exit-code 1 --python read_in_blender.py -- FILE OUT SECONDS...
"""

import sys

import bpy
import numpy as np

if not hasattr(np, "bool"):
    np.bool = bool  # the importer of Debian's Blender 3.4 needs it, Debian's numpy 1.24 no longer has it
file, out, *seconds = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=file)
(tissue,) = (found for found in bpy.data.objects if found.type == "MESH")
scene, positions = bpy.context.scene, []
for second in map(float, seconds):
    frame = second * scene.render.fps
    scene.frame_set(int(frame), subframe=frame - int(frame))
    moved = tissue.evaluated_get(bpy.context.evaluated_depsgraph_get())
    positions.append([moved.matrix_world @ vertex.co for vertex in moved.data.vertices])
(attribute,) = tissue.data.color_attributes
corners = [loop.vertex_index for loop in tissue.data.loops]
materials = [{node.type for node in material.node_tree.nodes} for material in tissue.data.materials]
np.savez(
    out,
    positions=np.array(positions),  # (T, V, 3) m, Blender's axes
    triangles=np.array([polygon.vertices for polygon in tissue.data.polygons]),
    colors=np.array([tuple(item.color) for item in attribute.data]),  # (3 F, 4) linear, of the corners
    corners=np.array(corners),  # (3 F,) vertex of each corner
    shows_colors=np.array([bool({"VERTEX_COLOR", "ATTRIBUTE"} & found) for found in materials]),
)
