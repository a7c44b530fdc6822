//! Compiles the `*.{vert,frag,comp}` of a folder with glslangValidator, and turns the reflection of the SPIR-V into Rust: one
//! `Shader` per file (words, bindings, push constant size, workgroup size) and one `#[repr(C)]` struct per GLSL struct in a
//! buffer or push constant. No binding and no layout is typed by hand in Rust.
//!
//! For build scripts: a failure ends the build with its reason. A crate that includes the result depends on this crate and on
//! `bytemuck`.

use spirq::prelude::*;
use spirq::spirv::ExecutionMode;
use spirq::ty::{DescriptorType, ScalarType, StructType, Type};
use spirq::var::Variable;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Compiles `folder` of the crate that is built into `generated`, a file of its `OUT_DIR`. Shaders see `macros`, names and values.
pub fn folder(folder: &str, macros: &[(&str, String)], generated: &str) {
    let glsl = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").expect("set by cargo")).join(folder);
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("set by cargo"));
    println!("cargo:rerun-if-changed={}", glsl.display());
    let mut files: Vec<_> = std::fs::read_dir(&glsl)
        .unwrap_or_else(|error| panic!("{} cannot be read: {error}", glsl.display()))
        .map(|entry| entry.expect("the folder can be listed").path())
        .filter(|path| matches!(extension(path), "vert" | "frag" | "comp"))
        .collect();
    files.sort();
    let mut structs = BTreeMap::new();
    let mut modules = String::new();
    for file in &files {
        let words = compile(file, macros, &out);
        describe(file, &words, &mut structs, &mut modules);
    }
    let structs: String = structs.into_values().collect();
    std::fs::write(out.join(generated), structs + &modules).expect("OUT_DIR can be written");
}

fn extension(path: &Path) -> &str {
    path.extension().and_then(|e| e.to_str()).unwrap_or("")
}

fn compile(file: &Path, macros: &[(&str, String)], out: &Path) -> Vec<u32> {
    let spv = out.join(file.file_name().expect("a file")).with_extension(format!("{}.spv", extension(file)));
    let mut command = Command::new("glslangValidator");
    command.args(["-V", "--target-env", "vulkan1.1", "--quiet"]);
    for (name, value) in macros {
        command.arg(format!("-D{name}={value}"));
    }
    command.arg("-o").arg(&spv).arg(file);
    let output = command.output().unwrap_or_else(|error| {
        panic!("cannot run glslangValidator ({error}): install it (Debian and Ubuntu: package glslang-tools)")
    });
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}:\n{text}", file.display());
    let bytes = std::fs::read(&spv).expect("glslangValidator wrote its output");
    bytes.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect()
}

fn describe(file: &Path, words: &[u32], structs: &mut BTreeMap<String, String>, modules: &mut String) {
    let stem = file.file_name().and_then(|n| n.to_str()).expect("utf-8 file name");
    let entry = ReflectConfig::new()
        .spv(words.to_vec())
        .ref_all_rscs(false)
        .reflect()
        .unwrap_or_else(|e| panic!("{stem}: reflection failed: {e}"))
        .remove(0);
    let mut bindings = Vec::new();
    let mut push_bytes = 0;
    for variable in &entry.vars {
        match variable {
            Variable::Descriptor { name, desc_bind, desc_ty, ty, nbind } => {
                assert_eq!(desc_bind.set(), 0, "{stem}: one descriptor set, set 0");
                collect_structs(ty, structs, stem);
                let name = match ty {
                    Type::Struct(block) => block.name.clone().unwrap_or_default(),
                    _ => name.clone().unwrap_or_default(),
                };
                bindings.push((desc_bind.bind(), kind(desc_ty, stem), *nbind, name));
            }
            Variable::PushConstant { ty, .. } => {
                let Type::Struct(block) = ty else { panic!("{stem}: push constants are a block") };
                emit_struct(block, structs, stem);
                push_bytes = round_up(ty.nbyte().expect("push constants have a size"), 4);
            }
            _ => {}
        }
    }
    bindings.sort();
    let (stage, constant) = (extension(file), stem.replace('.', "_").to_uppercase());
    let words: Vec<_> = words.iter().map(|w| format!("{w:#x}")).collect();
    writeln!(modules, "/// `{stem}`, compiled and reflected.\npub static {constant}: shadecast_spirv::Shader = shadecast_spirv::Shader {{ name: \"{stem}\", stage: shadecast_spirv::Stage::{},", stage_name(stage)).unwrap();
    let workgroup = workgroup(&entry);
    assert_eq!(workgroup.is_some(), stage == "comp", "{stem}: compute shaders have a workgroup size");
    writeln!(
        modules,
        "push_bytes: {push_bytes}, workgroup: {workgroup:?}, words: &[{}], bindings: &[",
        words.join(",")
    )
    .unwrap();
    for (index, kind, count, name) in bindings {
        writeln!(
            modules,
            "shadecast_spirv::Binding {{ index: {index}, kind: shadecast_spirv::BindingKind::{kind}, count: {count}, name: \"{name}\" }},"
        )
        .unwrap();
    }
    modules.push_str("] };\n");
}

/// The local size as compiled. None of our shaders specialises it.
fn workgroup(entry: &EntryPoint) -> Option<[u32; 3]> {
    let size = entry.exec_modes.iter().find(|mode| mode.exec_mode == ExecutionMode::LocalSize)?;
    let sides = size.operands.iter().map(|side| match side.value {
        ConstantValue::U32(side) => side,
        ref other => panic!("{}: {other:?} is no side of a workgroup", entry.name),
    });
    Some(sides.collect::<Vec<_>>().try_into().expect("a workgroup has three sides"))
}

fn stage_name(extension: &str) -> &'static str {
    match extension {
        "vert" => "Vertex",
        "frag" => "Fragment",
        _ => "Compute",
    }
}

fn kind(ty: &DescriptorType, stem: &str) -> &'static str {
    match ty {
        DescriptorType::UniformBuffer() => "UniformBuffer",
        DescriptorType::StorageBuffer(_) => "StorageBuffer",
        DescriptorType::CombinedImageSampler() => "SampledImage",
        DescriptorType::StorageImage(_) => "StorageImage",
        other => panic!("{stem}: descriptor type {other:?} is not used in this project"),
    }
}

/// Emits the structs inside a buffer block; a block that ends in a runtime array is not emitted itself.
fn collect_structs(ty: &Type, structs: &mut BTreeMap<String, String>, stem: &str) {
    match ty {
        Type::Array(array) => collect_structs(&array.element_ty, structs, stem),
        Type::Struct(block) => {
            let open_ended =
                block.members.iter().any(|m| matches!(&m.ty, Type::Array(a) if a.nelement.is_none()));
            if open_ended {
                block.members.iter().for_each(|m| collect_structs(&m.ty, structs, stem));
            } else {
                emit_struct(block, structs, stem);
            }
        }
        _ => {}
    }
}

fn emit_struct(block: &StructType, structs: &mut BTreeMap<String, String>, stem: &str) {
    let name = block.name.clone().unwrap_or_else(|| panic!("{stem}: a struct has no name"));
    let (mut fields, mut checks, mut at, mut align) = (String::new(), String::new(), 0, 4);
    for (index, member) in block.members.iter().enumerate() {
        collect_structs(&member.ty, structs, stem);
        let field = member.name.clone().unwrap_or_else(|| panic!("{stem}: {name} has a nameless member"));
        let offset = member.offset.unwrap_or_else(|| panic!("{stem}: {name}.{field} has no offset"));
        if offset > at {
            writeln!(
                fields,
                "    /// Alignment of the next member.\n    pub _pad{index}: [u8; {}],",
                offset - at
            )
            .unwrap();
        }
        let (rust, bytes) = rust_type(&member.ty, stem);
        align = align.max(member_align(&member.ty));
        writeln!(fields, "    /// See the GLSL struct.\n    pub {field}: {rust},").unwrap();
        writeln!(checks, "const _: () = assert!(std::mem::offset_of!({name}, {field}) == {offset});")
            .unwrap();
        at = offset + bytes;
    }
    let tail = round_up(at, align) - at;
    if tail > 0 {
        writeln!(fields, "    /// Size is a multiple of the alignment.\n    pub _pad_end: [u8; {tail}],")
            .unwrap();
    }
    let text = format!(
        "/// Layout of the GLSL struct `{name}`.\n#[repr(C)]\n#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable, bytemuck::Pod)]\npub struct {name} {{\n{fields}}}\n{checks}"
    );
    if let Some(known) = structs.insert(name.clone(), text.clone()) {
        assert_eq!(known, text, "{stem}: {name} has another layout in another shader");
    }
}

/// The struct's size is rounded to 16 only where std140/std430 would: a member of vec3, vec4 or matrix type.
/// Shaders with scalar layout keep such members last or write their padding out.
fn member_align(ty: &Type) -> usize {
    match ty {
        Type::Vector(v) if v.nscalar >= 3 => 16,
        Type::Vector(v) if v.nscalar == 2 => 8,
        Type::Matrix(_) => 16,
        Type::Array(a) => member_align(&a.element_ty),
        Type::Struct(s) => s.members.iter().map(|m| member_align(&m.ty)).max().unwrap_or(4),
        _ => 4,
    }
}

fn rust_type(ty: &Type, stem: &str) -> (String, usize) {
    match ty {
        Type::Scalar(scalar) => (scalar_type(scalar, stem).to_owned(), 4),
        Type::Vector(v) => {
            (format!("[{}; {}]", scalar_type(&v.scalar_ty, stem), v.nscalar), 4 * v.nscalar as usize)
        }
        Type::Matrix(m) => {
            assert_eq!(m.vector_ty.nscalar, 4, "{stem}: matrices have four rows");
            (format!("[[f32; 4]; {}]", m.nvector), 16 * m.nvector as usize)
        }
        Type::Array(a) => {
            let (element, bytes) = rust_type(&a.element_ty, stem);
            let count = a.nelement.unwrap_or_else(|| panic!("{stem}: a runtime array inside a struct"));
            assert_eq!(a.stride, Some(bytes), "{stem}: array elements must be tight, use vec4 or scalars");
            (format!("[{element}; {count}]"), bytes * count as usize)
        }
        Type::Struct(s) => {
            let bytes = ty.nbyte().expect("nested structs have a size");
            let align = s.members.iter().map(|m| member_align(&m.ty)).max().unwrap_or(4);
            (s.name.clone().expect("named"), round_up(bytes, align))
        }
        other => panic!("{stem}: type {other:?} cannot cross to the CPU"),
    }
}

fn scalar_type(scalar: &ScalarType, stem: &str) -> &'static str {
    match scalar {
        ScalarType::Float { bits: 32, .. } => "f32",
        ScalarType::Integer { bits: 32, is_signed: true } => "i32",
        ScalarType::Integer { bits: 32, is_signed: false } => "u32",
        other => panic!("{stem}: scalar {other:?} cannot cross to the CPU"),
    }
}

fn round_up(bytes: usize, align: usize) -> usize {
    bytes.div_ceil(align) * align
}
