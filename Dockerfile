# The program for the CPU. Build and use: docs/install.md.
FROM python:3.12-slim
# OpenMP, for Numba's threads.
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY pyproject.toml setup.py constraints.txt README.md LICENSE THIRD_PARTY_NOTICES.md ./
COPY docs docs
COPY src src
# The image has no repository to read the commit from.
ARG COMMIT=""
RUN if [ -n "$COMMIT" ]; then echo "$COMMIT" > src/endoprior/commit.txt; fi \
 && pip install --no-cache-dir -c constraints.txt torch --no-deps --index-url https://download.pytorch.org/whl/cpu \
 && pip install --no-cache-dir -c constraints.txt . \
 && rm -rf build \
 && mkdir -m 1777 /cache /data
# Any user may run it; no Python imports files of the data. Compiled kernels and downloaded weights go to /cache: keep it in a volume.
ENV HOME=/cache NUMBA_CACHE_DIR=/cache/kernels PYTHONSAFEPATH=1
USER 1000
VOLUME /cache /data
WORKDIR /data
ENTRYPOINT ["endoprior"]
CMD ["--help"]
