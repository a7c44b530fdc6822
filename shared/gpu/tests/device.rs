//! The device opens with validation, runs work, retires what is dropped, and says nothing to the layers.

use shadecast_gpu::{Access, Buffer, DesktopDevice, Gpu, GpuOptions, Memory, Needs};
use std::sync::Arc;

fn open(needs: Needs) -> Arc<Gpu> {
    let options = GpuOptions { needs, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

#[test]
fn both_feature_sets_open_and_pass_the_multiview_self_test_without_a_validation_message() {
    for needs in [Needs::Server, Needs::Client] {
        let gpu = open(needs);
        assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
    }
}

#[test]
fn copies_arrive_and_buffers_dropped_while_in_use_outlive_the_work() {
    let gpu = open(Needs::Client);
    let data: Vec<u32> = (0..1000).collect();
    let source = Buffer::upload(&gpu, "source", &data).unwrap();
    let target = Buffer::new(&gpu, "target", 4000, Memory::Readback).unwrap();
    let mut recorder = gpu.record().unwrap();
    recorder.scope("copy", |r| r.copy_buffer(&source, 0, &target, 0, 4000));
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    let ticket = recorder.submit().unwrap();
    drop(source);
    gpu.wait(ticket).unwrap();
    assert_eq!(&target.values::<u32>()[..1000], &data[..]);
    assert_eq!(gpu.take_timings_ms().len(), 1);
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}

#[test]
fn an_unknown_device_name_is_an_error_that_lists_what_there_is() {
    let options =
        GpuOptions { needs: Needs::Client, validation: false, device_name: Some("no such device".into()) };
    let error = Gpu::open(&options, &DesktopDevice).expect_err("refused").to_string();
    assert!(error.contains("not the one asked for"), "{error}");
}
