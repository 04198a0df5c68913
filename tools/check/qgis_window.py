"""Opens a run's project.qgz and layers.gpkg in a real QGIS, checks what it made of them, draws its window.

Run by the Python that QGIS has (`make check-qgis` finds it): no package of this project is imported.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from qgis.core import (
    Qgis,
    QgsApplication,
    QgsExpression,
    QgsExpressionContext,
    QgsExpressionContextUtils,
    QgsLayerTreeModel,
    QgsMapLayer,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsProject,
    QgsProviderRegistry,
    QgsRasterLayer,
    QgsRenderContext,
    QgsVectorLayer,
)
from qgis.gui import QgsLayerTreeView, QgsMapCanvas
from qgis.PyQt.QtCore import QSize, Qt, QVariant
from qgis.PyQt.QtGui import QImage, QPixmap
from qgis.PyQt.QtWidgets import QLabel, QSplitter

WIDTH, HEIGHT, TREE = 1500, 900, 390
OURS = "geomosaic_"


def fail(text: str) -> None:
    sys.exit(f"check-qgis: {text}")


def check_layer(layer: QgsMapLayer) -> None:
    if not layer.isValid():
        fail(f"{layer.name()} is not valid: {layer.error().message()}")
    if not layer.crs().isValid():
        fail(f"{layer.name()} has no CRS")
    if isinstance(layer, QgsVectorLayer):
        kind = layer.renderer().type()
        if kind not in ("singleSymbol", "categorizedSymbol", "graduatedSymbol"):
            fail(f"{layer.name()} is drawn by {kind}")
        print(f"  {layer.name()}: {layer.featureCount()} features, {kind}")
        check_expressions(layer)
    elif isinstance(layer, QgsRasterLayer):
        print(f"  {layer.name()}: {layer.width()} x {layer.height()}, {layer.renderer().type()}")


def check_expressions(layer: QgsVectorLayer) -> None:
    """What the style computes can be computed for the first feature."""
    texts = [layer.renderer().legendClassificationAttribute()]
    if layer.labeling() is not None:
        texts.append(layer.labeling().settings().fieldName)
    for symbol in layer.renderer().symbols(QgsRenderContext()):
        texts += [part.geometryExpression() for part in symbol if hasattr(part, "geometryExpression")]
    context = QgsExpressionContext(QgsExpressionContextUtils.globalProjectLayerScopes(layer))
    for feature in layer.getFeatures():
        context.setFeature(feature)
        for text in filter(None, texts):
            expression = QgsExpression(text)
            expression.evaluate(context)
            if expression.hasParserError() or expression.hasEvalError():
                error = expression.parserErrorString() or expression.evalErrorString()
                fail(f"{layer.name()}: {text}: {error}")
        break


def styles_of_its_own(package: Path, project: QgsProject) -> None:
    """Layers dropped onto an empty map look as they do in the project."""
    known = {
        layer.dataProvider().dataSourceUri().split("layername=")[-1]: layer
        for layer in project.mapLayers().values()
        if isinstance(layer, QgsVectorLayer)
    }
    names = [d.name() for d in QgsProviderRegistry.instance().querySublayers(str(package))]
    if "layer_styles" in names:
        names.remove("layer_styles")
    for name in names:
        layer = QgsVectorLayer(f"{package}|layername={name}", name, "ogr")
        text, found = layer.loadDefaultStyle()
        if not found:
            fail(f"{name} has no style of its own: {text}")
        if name in known and layer.renderer().dump() != known[name].renderer().dump():
            fail(f"{name} looks otherwise in the project")
        for field in layer.fields():
            if field.name() == "time_utc" and field.type() != QVariant.DateTime:
                fail(f"{name}.time_utc is {field.typeName()}")
    print(f"  {len(names)} layers of {package.name} open in their styles")


def draw(
    project: QgsProject, canvas: QgsMapCanvas, out: Path, part: float, show: list[str], hide: list[str]
) -> None:
    """The window: tree and map."""
    root, extent = project.layerTreeRoot(), canvas.extent()
    for node in root.findLayers():
        name = node.layerId().removeprefix(OURS)
        if name in show + hide:
            node.setItemVisibilityChecked(name in show)
    view = QgsLayerTreeView()
    model = QgsLayerTreeModel(root)
    model.setFlag(QgsLayerTreeModel.AllowNodeChangeVisibility)
    view.setModel(model)
    canvas.setExtent(extent)
    canvas.zoomByFactor(part)
    settings = QgsMapSettings()
    settings.setLayers([node.layer() for node in root.findLayers() if node.isVisible()])
    settings.setDestinationCrs(project.crs())
    settings.setTransformContext(project.transformContext())
    settings.setOutputSize(QSize(WIDTH - TREE, HEIGHT))
    settings.setExtent(canvas.extent())
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    if job.errors():
        fail(f"{job.errors()[0].layerID}: {job.errors()[0].message}")
    label = QLabel()
    label.setPixmap(QPixmap.fromImage(job.renderedImage()))
    window = QSplitter(Qt.Horizontal)
    window.addWidget(view)
    window.addWidget(label)
    window.resize(WIDTH, HEIGHT)
    window.setSizes([TREE, WIDTH - TREE])
    window.show()
    QgsApplication.processEvents()
    if not window.grab().save(str(out)):
        fail(f"{out} can't be written")
    image = QImage(str(out)).scaled(QSize(60, 36))
    colours = {image.pixel(x, y) for x in range(20, 60) for y in range(36)}
    if len(colours) < 20:
        fail(f"{out} shows hardly anything: {len(colours)} colours")
    print(f"  {out}: the window")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument(
        "--counts", type=Path, help="write the version and the counts of layers here, as JSON"
    )
    parser.add_argument("--show", default="", help="layers to switch on, by name")
    parser.add_argument("--hide", default="")
    parser.add_argument("--part", type=float, default=1.0, help="share of the map's width that is shown")
    options = parser.parse_args()
    QgsApplication.setPrefixPath("/usr", True)
    application = QgsApplication([], True)
    application.initQgis()
    run: Path = options.run.resolve()
    project, canvas = QgsProject.instance(), QgsMapCanvas()
    canvas.setObjectName("theMapCanvas")
    project.readProject.connect(canvas.readProject)
    if not project.read(str(run / "project.qgz")):
        fail(f"project.qgz can't be read: {project.error()}")
    if not project.crs().isValid():
        fail("project.qgz has no CRS")
    print(f"{run.name} in QGIS, {project.crs().authid() or project.crs().description()}")
    layers = list(project.mapLayers().values())
    if not layers:
        fail("project.qgz is empty")
    good = 0
    for layer in layers:
        try:
            check_layer(layer)
            good += 1
        except SystemExit as error:
            print(error, file=sys.stderr)
    if options.counts is not None:
        version = ".".join(Qgis.version().split(".")[:2])
        counts = {"version": version, "layers": len(layers), "good": good}
        options.counts.write_text(json.dumps(counts))
    if good < len(layers):
        fail(f"{len(layers) - good} of {len(layers)} layers fail")
    for node in project.layerTreeRoot().findLayers():
        if node.layer() is None:
            fail(f"the tree's {node.layerId()} is no layer of the project")
    groups = [group.name() for group in project.layerTreeRoot().findGroups()]
    print(f"  groups: {', '.join(groups)}")
    styles_of_its_own(run / "layers.gpkg", project)
    if options.picture is not None:
        draw(project, canvas, options.picture, options.part, options.show.split(","), options.hide.split(","))
    project.clear()
    application.exitQgis()


main()
