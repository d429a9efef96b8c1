"""Renders generated scenes (.glb) as RGB images with Blender's path tracer, pixel for pixel over their transients.

    pip install bpy                                     # Blender as a module; its Python version is on PyPI
    python blender.py ROOM.glb … --out rgb [--samples 256] [--resolution PX]

Or with a Blender that is installed: blender -b -P blender.py -- ROOM.glb … --out rgb

For each scene: NAME.png (sRGB) and NAME.exr (layers: linear radiance, and z-depth in metres). Camera and intrinsics are the scene's
own. The laser does not shine: the light is a square area light under the middle of the ceiling, half as wide as the room, and the
exposure brings the median pixel to 0.18. The noise of an image falls with the square root of --samples; no denoiser is used.
"""

import argparse
import json
import math
import pathlib
import struct
import sys

import bpy
import mathutils


def extras(path):
    """What the scene says of itself: the JSON chunk of the .glb."""
    data = path.read_bytes()
    if data[:4] != b"glTF":
        sys.exit(f"{path}: expected a binary glTF (.glb), as `picofarm scene generate` writes it")
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])["scenes"][0].get("extras", {}).get("picofarm")
    if scene is None:
        sys.exit(f"{path}: has no camera of this program; write it again with `picofarm scene export`")
    return scene


def to_blender(v):
    """glTF has y up, Blender z."""
    x, y, z = v if isinstance(v, list) else (v["x"], v["y"], v["z"])
    return mathutils.Vector((x, -z, y))


def put_camera(of, resolution):
    inside, scene = of["intrinsics"], bpy.context.scene
    width, height = inside["width"], inside["height"]
    if resolution:
        width, height = resolution, round(resolution * height / width)
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = inside["fx"] / inside["width"] * data.sensor_width
    # Blender counts shifts in widths of the image, to the right and up.
    data.shift_x = 0.5 - inside["cx"] / inside["width"]
    data.shift_y = (inside["cy"] - inside["height"] / 2) / inside["width"]
    data.clip_start, data.clip_end = 1e-3, 1e3
    right, up, back = to_blender(of["right"]), -to_blender(of["down"]), -to_blender(of["forward"])
    camera = bpy.data.objects.new("camera", data)
    camera.matrix_world = mathutils.Matrix.Translation(to_blender(of["origin"])) @ mathutils.Matrix(
        [[right[i], up[i], back[i]] for i in range(3)]
    ).to_4x4()
    scene.collection.objects.link(camera)
    scene.camera = camera
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, inside["fx"] / inside["fy"]


def put_light():
    """A square light under the middle of the ceiling: of the scene's box, if there is none."""
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH"]
    corners = [o.matrix_world @ mathutils.Vector(c) for o in meshes for c in o.bound_box]
    low = [min(c[i] for c in corners) for i in range(3)]
    high = [max(c[i] for c in corners) for i in range(3)]
    data = bpy.data.lights.new("light", "AREA")
    data.shape, data.size = "SQUARE", 0.5 * min(high[0] - low[0], high[1] - low[1])
    data.energy = 100.0 * data.size**2
    light = bpy.data.objects.new("light", data)
    light.location = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2] - 0.01 * (high[2] - low[2]))
    bpy.context.scene.collection.objects.link(light)


def settings(samples):
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = samples, False, False
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 32, 32, 32
    # No clamping: it would take light away.
    scene.cycles.sample_clamp_indirect, scene.cycles.blur_glossy = 0.0, 0.0
    scene.cycles.filter_width = 0.01
    scene.view_settings.view_transform = "Standard"
    scene.view_layers[0].use_pass_z = True


def expose(image):
    """The exposure that brings the median luminance to 0.18."""
    pixels = list(image.pixels)
    light = sorted(0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in zip(pixels[0::4], pixels[1::4], pixels[2::4]))
    median = light[len(light) // 2]
    return math.log2(0.18 / median) if median > 0 else 0.0


def render(path, out, samples, resolution):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    for other in [o for o in bpy.context.scene.objects if o.type in ("CAMERA", "LIGHT")]:
        bpy.data.objects.remove(other)
    put_camera(extras(path)["camera"], resolution)
    put_light()
    settings(samples)
    scene = bpy.context.scene
    form = scene.render.image_settings
    if hasattr(form, "media_type"):
        form.media_type = "MULTI_LAYER_IMAGE"
    form.file_format, form.color_depth, form.use_exr_interleave = "OPEN_EXR_MULTILAYER", "32", True
    scene.render.filepath = str(out / f"{path.stem}.exr")
    bpy.ops.render.render(write_still=True)
    if hasattr(form, "media_type"):
        form.media_type = "IMAGE"
    form.file_format, form.color_mode, form.color_depth = "OPEN_EXR", "RGB", "32"
    plain = out / f".{path.stem}.linear.exr"
    bpy.data.images["Render Result"].save_render(str(plain))
    scene.view_settings.exposure = expose(bpy.data.images.load(str(plain)))
    plain.unlink()
    form.file_format, form.color_depth = "PNG", "8"
    bpy.data.images["Render Result"].save_render(str(out / f"{path.stem}.png"))


def main():
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=pathlib.Path, metavar="ROOM.glb")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder for the images")
    parser.add_argument("--samples", type=int, default=256, help="light paths a pixel (default 256)")
    parser.add_argument("--resolution", type=int, metavar="PX", help="width of the image (default: the scene's)")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    for path in given.scenes:
        render(path.resolve(), given.out.resolve(), given.samples, given.resolution)
        print(f"wrote {given.out / path.stem}.png and .exr", flush=True)


main()
