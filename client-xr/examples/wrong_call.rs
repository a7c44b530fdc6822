//! A program that makes a call of OpenXR wrongly: what a layer that checks calls must see, or its silence over the client means
//! nothing.

use openxr::sys::{InstanceProperties, StructureType};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // SAFETY: the system's own loader.
    let entry = unsafe { openxr::Entry::load(&())? };
    let application = openxr::ApplicationInfo { application_name: "wrong call", ..Default::default() };
    let instance = entry.create_instance(&application, &openxr::ExtensionSet::default(), &[], &())?;
    // SAFETY: zeros are a value of it.
    let mut properties: InstanceProperties = unsafe { std::mem::zeroed() };
    properties.ty = StructureType::SYSTEM_PROPERTIES;
    // SAFETY: the place is large enough for what is written; that its type is another one is the fault that is to be seen.
    let result = unsafe { (instance.fp().get_instance_properties)(instance.as_raw(), &mut properties) };
    println!("{result:?}");
    Ok(())
}
