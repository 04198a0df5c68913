"""The adjusted block for other programs: COLMAP, OpenSfM, OpenDroneMap, Metashape, Pix4D."""

from __future__ import annotations

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.colmap import write_colmap
from geomosaic.export.opensfm import write_opensfm
from geomosaic.export.orientation import orientations
from geomosaic.export.references import write_metashape, write_odm_control, write_odm_geo, write_pix4d
from geomosaic.export.sfm import sfm_block
from geomosaic.geodesy.mapcrs import check_on_earth, is_local
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile
from geomosaic.placement.model import Placement
from geomosaic.survey.model import Survey

COLMAP, OPENSFM, ODM = "colmap", "opensfm", "odm"
METASHAPE, PIX4D = "metashape.csv", "pix4d.csv"


def _warn_of_spaces(survey: Survey, program: str, context: Context) -> None:
    if any(" " in frame.name for frame in survey.frames):
        text = f"frames have spaces in their names, which {program} reads as separators: rename them to use "
        context.warn("spaces-in-names", "", text + "these files there")


@stage(
    "export.colmap", "Write the block for COLMAP", group="Export", version=3, outputs="colmap_folder",
    results=(COLMAP,),
)  # fmt: skip
def export_colmap(survey: Survey, ties: TiePoints, adjusted: Adjusted, context: Context) -> RunFile:
    """Writes colmap/: cameras.txt, images.txt and points3D.txt, in metres east, north and up."""
    _warn_of_spaces(survey, "COLMAP", context)
    block = sfm_block(survey, ties, adjusted)
    at = survey.work_frame
    with context.writing(COLMAP) as folder:
        folder.mkdir()
        origin = (at.lon_deg, at.lat_deg, at.height_ellipsoidal_m)
        write_colmap(folder, block, None if is_local(survey.map_crs) else origin)
    return context.run_file(COLMAP)


@stage(
    "export.opensfm", "Write the block for OpenSfM", group="Export", version=2, outputs="opensfm_folder",
    results=(OPENSFM,),
)  # fmt: skip
def export_opensfm(survey: Survey, ties: TiePoints, adjusted: Adjusted, context: Context) -> RunFile:
    """Writes opensfm/: reconstruction.json, tracks.csv, camera_models.json and reference_lla.json."""
    check_on_earth(survey.map_crs, "reconstruction of OpenSfM")
    block = sfm_block(survey, ties, adjusted)
    at, times = survey.work_frame, tuple(survey.frames[i].time_s for i in block.frames)
    with context.writing(OPENSFM) as folder:
        folder.mkdir()
        write_opensfm(folder, block, (at.lon_deg, at.lat_deg, at.height_ellipsoidal_m), times)
    return context.run_file(OPENSFM)


@stage(
    "export.odm", "Write positions for OpenDroneMap", group="Export", version=4, outputs="odm_folder",
    results=(ODM,),
)  # fmt: skip
def export_odm(survey: Survey, placement: Placement, adjusted: Adjusted, context: Context) -> RunFile:
    """Writes odm/: geo.txt with the adjusted positions and attitudes, gcp_list.txt with the control points.

    Copy both into the parent of the folder of images. Check points go to check_list.txt, which OpenDroneMap
    leaves alone.
    """
    check_on_earth(survey.map_crs, "list of positions")
    _warn_of_spaces(survey, "OpenDroneMap", context)
    with context.writing(ODM) as folder:
        folder.mkdir()
        write_odm_geo(folder / "geo.txt", orientations(survey, placement.poses, adjusted))
        for name, check in (("gcp_list.txt", False), ("check_list.txt", True)):
            points = [point for point in survey.control if point.check is check]
            if any(point.images for point in points):
                write_odm_control(folder / name, points, survey.map_crs)
    return context.run_file(ODM)


@stage(
    "export.metashape", "Write positions for Metashape", group="Export", version=2, outputs="metashape_file",
    results=(METASHAPE,),
)  # fmt: skip
def export_metashape(survey: Survey, placement: Placement, adjusted: Adjusted, context: Context) -> RunFile:
    """Writes metashape.csv, a camera reference: adjusted positions and yaw, pitch, roll in WGS 84."""
    check_on_earth(survey.map_crs, "list of positions")
    with context.writing(METASHAPE) as path:
        write_metashape(path, orientations(survey, placement.poses, adjusted))
    return context.run_file(METASHAPE)


@stage(
    "export.pix4d", "Write positions for Pix4D", group="Export", version=2, outputs="pix4d_file",
    results=(PIX4D,),
)  # fmt: skip
def export_pix4d(survey: Survey, placement: Placement, adjusted: Adjusted, context: Context) -> RunFile:
    """Writes pix4d.csv, an image geolocation: adjusted positions in WGS 84 and omega, phi, kappa."""
    check_on_earth(survey.map_crs, "list of positions")
    with context.writing(PIX4D) as path:
        write_pix4d(path, orientations(survey, placement.poses, adjusted))
    return context.run_file(PIX4D)
