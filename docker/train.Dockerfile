# The workstation: everything, with torch on CUDA. .ci/check_docker runs the install steps without docker.
#   docker build -f docker/train.Dockerfile -t cohdc-train .
#   docker run --rm --gpus all --shm-size 8g -v "$PWD:/data" cohdc-train fit --help
FROM nvidia/cuda:13.0.1-base-ubuntu24.04
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-pip \
    && rm -rf /var/lib/apt/lists/*
# The image is the environment: nothing else in it uses the system's Python.
ENV PIP_BREAK_SYSTEM_PACKAGES=1
WORKDIR /opt/cohdc
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY cohdc_train cohdc_train
COPY configs configs
RUN python3 -m pip install --no-cache-dir -c constraints.txt '.[train]'
RUN cohdc env && cohdc export --help > /dev/null
WORKDIR /data
ENTRYPOINT ["cohdc"]
CMD ["--help"]
