"""One service as `deploy/running/serve.py` runs it, with the encoder that reads painted pictures."""

import sys

from prior_sg.deploy.running import serve
from prior_sg.services.feature_pyramid.encoders.base import FAMILIES

if __name__ == "__main__":
    FAMILIES["painted/"] = "tests.chaos.painted"
    sys.exit(serve.main())
