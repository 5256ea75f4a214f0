import subprocess
import sys


def test_importing_viz_loads_neither_pyvista_nor_matplotlib():
    program = (
        "import sys, kfgs.viz; "
        "print(sorted({'pyvista', 'vtkmodules', 'matplotlib', 'skimage.segmentation'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert result.stdout.strip() == "[]"
