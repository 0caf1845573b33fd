# Training on CPUs: everything, in a quarter of the space of the GPU image when TORCH_INDEX is given.
#   docker build -f docker/train-cpu.Dockerfile --build-arg TORCH_INDEX=URL -t cohdc-train-cpu .
# URL is the index of PyTorch's CPU wheels, from its installation page. Without it pip takes the default wheels, which
# hold CUDA on x86-64 and are for the CPU on aarch64. .ci/check_docker runs the install steps without docker.
FROM python:3.11-slim
ARG TORCH_INDEX=""
RUN useradd --create-home cohdc && install -d -o cohdc /data
WORKDIR /opt/cohdc
COPY pyproject.toml README.md LICENSE constraints.txt ./
RUN test -z "$TORCH_INDEX" || python3 -m pip install --no-cache-dir -c constraints.txt --index-url "$TORCH_INDEX" torch torchvision
COPY cohdc_train cohdc_train
COPY configs configs
RUN python3 -m pip install --no-cache-dir -c constraints.txt '.[train]'
# Downloaded weights and caches go where any --user may write.
ENV HOME=/tmp
USER cohdc
RUN cohdc env && cohdc export --help > /dev/null
WORKDIR /data
ENTRYPOINT ["cohdc"]
CMD ["--help"]
