# A small image in which torchrl-her trains: the wheel with its compiled C++ code, and no compiler.
#   CPU: docker build -t torchrl-her .
#   GPU: docker build -t torchrl-her --build-arg BASE=nvidia/cuda:13.0.1-base-ubuntu24.04 .
ARG BASE=python:3.13-slim-bookworm

# The wheel is for systems with the glibc of this one, or a newer one.
FROM python:3.13-slim-bookworm AS wheel
RUN apt-get update && apt-get install --yes --no-install-recommends g++ make
WORKDIR /src
COPY . .
RUN make wheel

FROM ${BASE}
RUN command -v python3 || { apt-get update && apt-get install --yes --no-install-recommends python3 \
    && rm -rf /var/lib/apt/lists/*; }
# NVIDIA's images set CUDA_VERSION; elsewhere torch comes without CUDA's libraries, which are most of it.
RUN --mount=type=bind,from=wheel,source=/src,target=/src \
    if [ -z "$CUDA_VERSION" ]; then export UV_TORCH_BACKEND=cpu; fi; \
    /src/.venv/bin/uv venv --python python3 /opt/venv \
    && VIRTUAL_ENV=/opt/venv /src/.venv/bin/uv pip install --no-cache /src/dist/*.whl
ENV PATH=/opt/venv/bin:$PATH
WORKDIR /workspace
ENTRYPOINT ["torchrl-her"]
CMD ["train", "preset=demo"]
