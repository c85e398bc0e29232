# mjhab on the CPU: no GPU, no OpenGL and no network are needed once the image is built.
#
#   docker build -t mjhab .
#   docker run --rm -v "$PWD/runs:/work/runs" mjhab demo
#
# Building needs a package registry and nothing else: wheels bring MuJoCo, ffmpeg and all other libraries. Behind a mirror:
#   docker build --build-arg PIP_INDEX_URL=https://mirror.example/simple -t mjhab .
ARG PYTHON=3.12
FROM python:${PYTHON}-slim AS wheel
WORKDIR /build
COPY pyproject.toml README.md LICENSE ./
COPY src src
ARG PIP_INDEX_URL
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:${PYTHON}-slim
ARG PIP_INDEX_URL
ARG EXTRAS=data,learn,view,serve
COPY constraints.txt /tmp/constraints.txt
RUN --mount=type=bind,from=wheel,source=/wheels,target=/wheels \
    pip install --no-cache-dir -c /tmp/constraints.txt "mjhab[${EXTRAS}] @ file://$(ls /wheels/*.whl)"
# Somebody without rights: compiled kernels and settled homes go to the cache, results to the mounted folder.
RUN useradd --create-home mjhab && mkdir -p /work/runs && chown -R mjhab /work
USER mjhab
WORKDIR /work
ENV MJHAB_CACHE=/home/mjhab/.cache/mjhab NUMBA_CACHE_DIR=/home/mjhab/.cache/numba
RUN mjhab warmup --task set_table
ENTRYPOINT ["mjhab"]
CMD ["--help"]
