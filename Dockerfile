# padgs for Docker, Podman, pods and Apptainer; docs/cluster.md says how to use it.
#   podman build -t padgs .
#   podman build -t padgs:cuda --build-arg BUILDER=docker.io/nvidia/cuda:12.8.1-devel-ubuntu22.04 \
#       --build-arg CUDA=ON --build-arg TORCH=https://download.pytorch.org/whl/cu128 .
ARG BUILDER=docker.io/library/debian:bookworm-slim

# Only the kernels are compiled with the builder's compilers. Their wheel fits any Python, and any system as recent.
FROM ${BUILDER} AS wheel
ARG CUDA=OFF
RUN apt-get update && apt-get install -y --no-install-recommends g++ python3-venv && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN python3 -m venv /build && /build/bin/pip wheel --no-cache-dir --no-deps -w /wheels /source \
    --config-settings=cmake.define.PADGS_CUDA=${CUDA} --config-settings=cmake.define.PADGS_CUDA_ARCHITECTURES=all

FROM docker.io/library/debian:bookworm-slim
ARG TORCH=https://download.pytorch.org/whl/cpu
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv libgl1 libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheels /wheels
COPY constraints.txt requirements-nodeps.txt /wheels/
RUN python3 -m venv /opt/padgs \
    && /opt/padgs/bin/pip install --no-cache-dir --extra-index-url ${TORCH} -c /wheels/constraints.txt \
        "$(echo /wheels/padgs-*.whl)[launchers,mlflow,ray,video,view]" \
    && /opt/padgs/bin/pip install --no-cache-dir --no-deps -r /wheels/requirements-nodeps.txt
# NVIDIA's runtimes show a container the GPU; caches go where any user may write.
ENV PATH=/opt/padgs/bin:$PATH NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    MPLCONFIGDIR=/tmp/matplotlib PADGS_CACHE=/tmp/padgs
WORKDIR /work
CMD ["padgs", "--help"]
