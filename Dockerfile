# The command line in an image.
#   CUDA:  docker build -t lidar-synth .
#   CPU:   docker build -t lidar-synth --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cpu .
#   docker run --rm -v "$PWD:/data" lidar-synth start scans    (on a GPU: --gpus all)
FROM python:3.12-slim
ARG TORCH_INDEX=""
WORKDIR /package
RUN pip install --no-cache-dir ${TORCH_INDEX:+--index-url ${TORCH_INDEX}} torch
COPY pyproject.toml README.md LICENSE ./
COPY tools/backend tools/backend
COPY configs configs
COPY integrations integrations
COPY lidar_synth lidar_synth
RUN pip install --no-cache-dir .
WORKDIR /data
ENTRYPOINT ["lidar-synth"]
