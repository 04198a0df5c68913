from geomosaic.runs import Judgement as Judgement
from geomosaic.runs import Run as Run
from geomosaic.runs import list_stages as list_stages
from geomosaic.runs import mosaic as mosaic
from geomosaic.runs import open_run as open_run
from geomosaic.runs import replay as replay
from geomosaic.runs import run as run
from geomosaic.runs import strips as strips

__version__: str
