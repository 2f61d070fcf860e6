"""Invalid input raises an error that names the tensor, the rule and the way out; no input crashes."""

from dataclasses import replace

import pytest
import torch
from support import render_cases as cases

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, Pinhole, RayTable
from padgs.native import cpu
from padgs.render import RenderConfig, RenderOptions, render
from padgs.scene import View

VIEW = View("v", cases.identity_pose(), 32, 16)
SQUARE = {"wrap": False, "bounds": "square"}


@pytest.fixture
def gaussians(generator: torch.Generator) -> Gaussians:
    return cases.gaussians_of("ordinary", 5, generator).to(torch.float32)


@pytest.mark.parametrize("name", cases.INPUTS)
def test_wrong_shapes_are_named(name: str, gaussians: Gaussians):
    for wrong in (getattr(gaussians, name)[:4], getattr(gaussians, name)[..., None], torch.zeros(())):
        if name == "means" and wrong.shape == (4, 3):
            message = r"quats has shape \(5, 4\); with 4 means it must be \(4, 4\)"
        else:
            message = rf"{name} has shape \({', '.join(map(str, wrong.shape))},?\); with \d means it must be"
        with pytest.raises(ValueError, match=message):
            render(replace(gaussians, **{name: wrong}), VIEW)


@pytest.mark.parametrize("name", cases.INPUTS)
def test_mixed_dtypes_and_devices_are_named(name: str, gaussians: Gaussians):
    other = getattr(gaussians, name)
    with pytest.raises(ValueError, match=rf"{'quats' if name == 'means' else name} has dtype torch.float.*convert"):
        render(replace(gaussians, **{name: other.double()}), VIEW)
    with pytest.raises(ValueError, match=rf"{'quats' if name == 'means' else name} is on .*; move one of them"):
        render(replace(gaussians, **{name: other.to("meta")}), VIEW.at(cases.identity_pose()))


def test_unusable_dtypes_are_named(gaussians: Gaussians):
    for dtype in (torch.float16, torch.int64):
        with pytest.raises(ValueError, match=f"means has dtype {dtype}; renderers take torch.float32 or torch.float64"):
            render(gaussians.to(dtype), VIEW)


def test_background_offsets_and_pose_are_checked(gaussians: Gaussians):
    with pytest.raises(ValueError, match=r"background has shape \(4,\); .* must be \(3,\)"):
        render(gaussians, VIEW, background=torch.zeros(4))
    with pytest.raises(ValueError, match="background has dtype torch.float64 but means has torch.float32"):
        render(gaussians, VIEW, background=torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"mean_offsets has shape \(5, 3\); with 5 means it must be \(5, 2\)"):
        render(gaussians, VIEW, mean_offsets=torch.zeros(5, 3))
    with pytest.raises(ValueError, match=r"background is a tuple; it must be a tensor of shape \(3,\)"):
        render(gaussians, VIEW, background=(0.0, 0.0, 0.0))
    for projection, count, message in (
        ("erp", 5, "requires projection 'ray', not 'erp'"),
        ("ray", 1, r"has shape \(1,\)"),
    ):
        with pytest.raises(ValueError, match=f"absgrad {message}"):
            render(gaussians, VIEW, RenderOptions(projection), absgrad=torch.zeros(count))
    with pytest.raises(ValueError, match=r"cam_from_world has shape \(3, 4\)"):
        render(gaussians, VIEW.at(cases.identity_pose()[:3]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": "tight"}, "unknown bounds 'tight'; known: exact, square"),
        ({"bounds": "square"}, "bounds=square end at the seam, as published; set wrap=false"),
        ({"near": -1.0}, "near is -1.0; it must be a distance >= 0"),
        ({"near": float("nan")}, "near is nan; it must be a distance >= 0"),
        ({"near_cull": "ellipsoid"}, "near_cull=ellipsoid requires projection 'ray', not 'erp'"),
        ({"near_cull": "box"}, "unknown near_cull 'box'; known: mean, ellipsoid"),
        ({"low_pass": -0.1}, "low_pass is -0.1; it must be a variance >= 0"),
        ({"projection": "ray", "low_pass_kind": "pixels"}, "'ray' has no .* 'pixels'; known: auto, solid, angular"),
        ({"projection": "tangent", "low_pass_kind": "pixels"}, "'tangent' has no .*; known: auto, angular, solid"),
        ({"low_pass_kind": "3d"}, "'erp' has no low_pass_kind '3d'; known: auto, pixels, angular, solid"),
        ({"steepness": 1.5, "projection": "ray"}, r"steepness is 1.5; it must be in \[0, 1\)"),
        ({"steepness": 0.2}, "steepness requires projection 'tangent' or 'ray', not 'erp'; set 0"),
        ({"max_instances": 0}, "max_instances is 0; it must be at least 1"),
        ({"projection": "ray", "wrap": False}, "projection 'ray' has no seam that wrap=false could cut; set wrap=true"),
        ({"projection": "tangent", "wrap": False}, "projection 'tangent' has no seam"),
        ({"blending": "oit"}, "unknown blending 'oit'; known: sorted, hybrid"),
        ({"core_size": 0}, "core_size is 0; it must be from 1 to 256"),
        ({"core_size": 257}, "core_size is 257; it must be from 1 to 256"),
        ({"core_size": 8}, "core_size is 8, but blending=sorted has no core; set blending=hybrid or core_size=16"),
        ({"supersampling": 1.5}, "supersampling is 1.5; it must be from 1 to 8"),
        ({"core_size": 3.5, "blending": "hybrid"}, "core_size is 3.5; it must be from 1 to 256"),
        ({"cubemap": True}, "projection 'erp' cannot render the faces of a cubemap; set pinhole, tangent or ray"),
    ],
)
def test_invalid_options_are_refused(options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        RenderOptions(**options)


def test_config_passes_options_on_and_scales_lengths():
    config = RenderConfig(projection="ray", blending="hybrid", core_size=8, near=0.5, low_pass_kind="angular")
    expected = {"projection": "ray", "blending": "hybrid", "core_size": 8, "low_pass_kind": "angular"}
    assert config.options(2.0) == RenderOptions(near=1.0, **expected)
    assert replace(config, near_unit="world").options(2.0) == RenderOptions(near=0.5, **expected)
    cubemap = {"projection": "pinhole", "cubemap": True}
    assert RenderConfig(near=0.0, **cubemap).options(1.0) == RenderOptions(**cubemap)


def test_unknown_names_list_the_known_ones(gaussians: Gaussians):
    for backend in ("torch", *(["cpu"] if cpu.available() else [])):
        with pytest.raises(ValueError, match="'mercator'; known: .*erp"):
            render(gaussians, VIEW, RenderOptions(projection="mercator"), backend=backend)
    with pytest.raises(ValueError, match="unknown backend 'gpu'; known: .*cpu.*torch"):
        render(gaussians, VIEW, backend="gpu")


@pytest.mark.parametrize(
    ("projection", "lens", "more", "message"),
    [
        ("erp", "pinhole", {}, "'erp' requires a Panorama camera, not a Pinhole; use tangent or ray, which take any"),
        ("erp", "fisheye", {}, "'erp' requires a Panorama camera, not a RayTable"),
        ("pinhole", "panorama", {}, "'pinhole' requires a Pinhole camera, not a Panorama; .*or set cubemap=true"),
        ("pinhole", "fisheye", {}, "'pinhole' requires a Pinhole camera, not a RayTable"),
        ("ray", "pinhole", {"cubemap": True}, "a cubemap gives a Panorama, not a Pinhole; set cubemap=false"),
        ("ray", "panorama", SQUARE, "projection 'ray' has no square bounds; use bounds=exact"),
        ("tangent", "pinhole", SQUARE, "'tangent' has square bounds for a Panorama only; use .* with a Pinhole"),
        ("tangent", "fisheye", SQUARE, "use bounds=exact with a RayTable"),
        ("tangent", "panorama", {**SQUARE, "cubemap": True}, "use bounds=exact with a cubemap"),
    ],
)
def test_unsupported_cameras_are_refused(projection, lens, more, message, gaussians: Gaussians):
    with pytest.raises(ValueError, match=message):
        render(gaussians, cases.view_of(cases.camera_of(lens, 32, 16)), RenderOptions(projection, **more))


@pytest.mark.parametrize("projection", ["tangent", "ray"])
@cases.each_engine
def test_a_bad_ray_spoils_its_own_pixel_only(projection: str, backend: str, dtype: torch.dtype, gaussians: Gaussians):
    options, camera = RenderOptions(projection), cases.camera_of("fisheye", 32, 16)
    expected = render(gaussians.to(dtype), cases.view_of(camera), options, backend=backend).image
    others = torch.ones(16, 32, dtype=torch.bool)
    others[3, 4] = False
    for value in (0.0, 2.0, float("nan"), float("inf")):
        table = camera.table.clone()
        table[3, 4] = table[3, 4] * value
        image = render(
            gaussians.to(dtype), cases.view_of(RayTable(table, camera.focal)), options, backend=backend
        ).image
        torch.testing.assert_close(image[others], expected[others])


PINHOLE, TABLE = Pinhole(32, 16, 10, 10, 16, 8), cases.camera_of("fisheye", 32, 16).table


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        *(
            (RayTable(torch.zeros(shape), 5.0), r"the ray table has shape \(.*\); it must be \(height, width, 3\)")
            for shape in [(16, 32), (16, 32, 2), (16, 32, 4), (3, 16, 32, 3), ()]
        ),
        *(
            (camera, f"image size is {camera.width}x{camera.height}; both sides must be at least 1 pixel")
            for width, height in [(0, 16), (32, 0), (-32, 16)]
            for camera in (
                Panorama(width, height),
                replace(PINHOLE, width=width, height=height),
                RayTable(torch.zeros(height, max(width, 0), 3), 5.0),
            )
        ),
        *(
            (camera, "focal length.*must be > 0 pixels")
            for focal in (0.0, -3.0, float("nan"))
            for camera in (replace(PINHOLE, fx=focal), replace(PINHOLE, fy=focal), RayTable(TABLE, focal))
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_impossible_cameras_are_refused(camera, message: str, gaussians: Gaussians):
    for projection in ("tangent", "ray", *(["pinhole"] if isinstance(camera, Pinhole) else [])):
        with pytest.raises(ValueError, match=message):
            render(gaussians, View("v", cases.identity_pose(), 32, 16, lens=camera), RenderOptions(projection))


@pytest.mark.parametrize("table_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("projection", ["tangent", "ray"])
@cases.each_engine
def test_ray_tables_may_have_any_dtype(projection, table_dtype, backend, dtype, gaussians: Gaussians):
    camera, weight = cases.camera_of("fisheye", 33, 16), torch.rand(16, 33, 3, dtype=dtype)
    results = []
    for table in (camera.table.to(dtype), camera.table.to(table_dtype)):
        # A strided table is as good as any.
        table = torch.stack((table, -table), dim=-1)[..., 0].requires_grad_()
        view = cases.view_of(RayTable(table, camera.focal))
        image = render(gaussians.to(dtype), view, RenderOptions(projection), backend=backend).image
        results.append((image, torch.autograd.grad((image * weight).sum(), table)[0]))
    assert torch.equal(results[0][0], results[1][0]) and results[0][0].any()
    assert results[1][1].dtype == table_dtype
    torch.testing.assert_close(results[1][1].to(dtype), results[0][1], rtol=1e-6, atol=1e-6)


@cases.needs_native
def test_the_cpu_backend_refuses_float64(gaussians: Gaussians):
    with pytest.raises(ValueError, match="backend cpu takes float32 .* got torch.float64 .*use backend=torch"):
        render(gaussians.to(torch.float64), VIEW, backend="cpu")


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
@cases.each_setup
@cases.each_engine
def test_without_gaussians_the_image_is_the_background(projection, lens, blending, backend, dtype):
    nothing = Gaussians(
        *(torch.zeros(0, *shape, dtype=dtype, requires_grad=True) for shape in ((3,), (4,), (3,), (), (3,)))
    )
    background = torch.tensor([0.25, 0.5, 0.75], dtype=dtype, requires_grad=True)
    extra = {"background": background, "mean_offsets": torch.zeros(0, 2, dtype=dtype), "backend": backend}
    view = cases.view_of(cases.camera_of(lens, 32, 16))
    rendering = render(nothing, view, RenderOptions(projection, blending=blending), **extra)
    assert torch.equal(rendering.image, background.expand(16, 32, 3))
    assert torch.equal(rendering.transmittance, torch.ones(16, 32, dtype=dtype))
    assert torch.equal(rendering.depth, torch.zeros(16, 32, dtype=dtype))
    assert rendering.visible.shape == (0,) and rendering.counters["contributing"] == 0
    rendering.image.sum().backward()
    assert background.grad.tolist() == [512.0] * 3


@cases.each_setup
@cases.each_engine
def test_tensors_need_not_be_contiguous(projection, lens, backend, dtype, gaussians: Gaussians):
    view, options = cases.view_of(cases.camera_of(lens, 32, 16)), RenderOptions(projection)
    reference = render(gaussians.to(dtype), view, options, backend=backend).image
    strided = {}
    for name, tensor in vars(gaussians.to(dtype)).items():
        wide = torch.stack((tensor, -torch.ones_like(tensor)), dim=-1)
        strided[name] = wide[..., 0]
        assert not strided[name].is_contiguous()
    assert torch.equal(render(Gaussians(**strided), view, options, backend=backend).image, reference)
